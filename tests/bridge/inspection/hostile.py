"""Objects that run code of their own, or never end, whenever they are asked for anything."""

from __future__ import annotations

from typing import Any

calls: list[str] = []


class LoudType(type):
    """A metaclass whose every method notes that it was called."""

    def __eq__(cls, other: object) -> bool:
        calls.append("metaclass ==")
        return True

    def __hash__(cls) -> int:
        calls.append("metaclass hash")
        return hash(str)

    def __getattribute__(cls, name: str) -> Any:
        calls.append(f"metaclass .{name}")
        return super().__getattribute__(name)

    def __instancecheck__(cls, instance: object) -> bool:
        calls.append("isinstance")
        return True


class Loud(metaclass=LoudType):
    """Notes each access; its own attribute is `kept`."""

    def __init__(self) -> None:
        object.__setattr__(self, "kept", 3)

    def __getattribute__(self, name: str) -> Any:
        calls.append(f".{name}")
        return object.__getattribute__(self, name)

    def __repr__(self) -> str:
        calls.append("repr")
        return "loud"

    def __len__(self) -> int:
        calls.append("len")
        return 10**9

    def __iter__(self) -> Any:
        calls.append("iter")
        return iter(int, 1)  # without end

    def __eq__(self, other: object) -> bool:
        calls.append("==")
        return True

    def __hash__(self) -> int:
        calls.append("hash")
        return hash("kept")

    def __getitem__(self, key: object) -> Any:
        calls.append("[]")
        return key

    @property
    def computed(self) -> int:
        calls.append("property")
        return 1


class Masked:
    """Its class pretends to be another, and its `__dict__` is a property."""

    @property
    def __class__(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        calls.append("__class__")
        return int

    @property
    def __dict__(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        calls.append("__dict__")
        return {"false": 1}


class Slotted:
    """Has a slot with a value and one without."""

    __slots__ = ("empty", "filled")

    def __init__(self) -> None:
        self.filled = 4


class LoudDict(dict[str, int]):
    """A dict that notes how it is read."""

    def __getitem__(self, key: str) -> int:
        calls.append("dict []")
        return 0

    def items(self) -> Any:
        calls.append("dict items")
        return super().items()

    def __len__(self) -> int:
        calls.append("dict len")
        return 0
