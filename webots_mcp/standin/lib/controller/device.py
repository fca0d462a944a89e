"""What all devices have in common."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from typing import Any

from . import session as library
from .arguments import integer
from .console import say
from .node_types import NUMBER_OF


class Device:
    """A device of the robot.

    `GPS("gps")` finds the device by name; the robot itself makes its devices by tag.
    """

    _c_name = "device"
    """As in the names of the C functions, for messages."""

    def __init__(self, name: int | str) -> None:
        session = library.current
        if session is None:
            raise RuntimeError("there are no devices before Robot() was made")
        self._session = session
        self._description = self._found(name)
        self._tag: int = self._description.get("tag", 0)

    def _found(self, name: int | str) -> dict[str, Any]:
        for description in self._session.robot["devices"]:
            if name in (description["tag"], description["name"]):
                return description
        say(f'Warning: "{name}" device not found.')
        return {}

    def _complain(self, what: str, complaint: str) -> None:
        say(f"Error: wb_{self._c_name}_{what}(){complaint}")

    def getName(self) -> str:
        """The `name` field."""
        return self._description.get("name", "")

    def getModel(self) -> str:
        """The `model` field."""
        return self._description.get("model", "")

    def getNodeType(self) -> int:
        """The number of the node type, to compare with `Node.GPS` and the like."""
        return NUMBER_OF.get(self._description.get("node_type", ""), 0)

    @property
    def name(self) -> str:
        """The `name` field."""
        return self.getName()

    @property
    def model(self) -> str:
        """The `model` field."""
        return self.getModel()

    @property
    def node_type(self) -> int:
        """The number of the node type."""
        return self.getNodeType()


class Sensor(Device):
    """A device that measures something every so often, once it is enabled."""

    def __init__(self, name: int | str, sampling_period: int | None = None) -> None:
        super().__init__(name)
        if isinstance(name, str):  # by name: enables, as the real package does
            basic_ms = int(self._session.robot["basic_time_step"])
            self.enable(basic_ms if sampling_period is None else sampling_period)

    def enable(self, p: int) -> None:
        """Measure every so many milliseconds, from the next step on; 0 disables."""
        if integer(p, position=2) < 0:
            self._complain("enable", " called with negative sampling period.")
        elif not self._tag:
            self._complain("enable", ": invalid device tag.")
        else:
            self._session.enable(self._tag, p)

    def disable(self) -> None:
        """Measure no longer; the last value stays."""
        self.enable(0)

    def getSamplingPeriod(self) -> int:
        """The sampling period in milliseconds, 0 if disabled."""
        with self._session.lock:
            return self._session.periods_ms.get(self._tag, 0)

    @property
    def sampling_period(self) -> int:
        """The sampling period in milliseconds, 0 if disabled."""
        return self.getSamplingPeriod()

    @sampling_period.setter
    def sampling_period(self, p: int | None) -> None:
        self.enable(0 if p is None else p)

    def _value(self, default: Any, what: str = "get_value") -> Any:
        if not self.getSamplingPeriod():
            use = f"Please use: wb_{self._c_name}_enable()."
            self._complain(what, f" called for a disabled device! {use}")
        return self._session.value(self._tag, default)
