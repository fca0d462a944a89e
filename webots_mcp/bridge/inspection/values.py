"""Values of any objects as bounded JSON, without running any code of the user.

No property, descriptor, `__getattr__`, `__repr__`, `__len__`, `__iter__` or metaclass of a class
that is not known is called. Items are read by the methods of Python's own containers.
"""

from __future__ import annotations

from collections import Counter, OrderedDict, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from math import isfinite
from types import (
    BuiltinFunctionType,
    CoroutineType,
    FunctionType,
    GeneratorType,
    MethodType,
    ModuleType,
)
from typing import Any, Final, cast

from webots_mcp.bridge.inspection.frames import has_text_keys
from webots_mcp.bridge.inspection.objects import (
    attributes_of,
    c_array_class,
    c_items,
    class_of,
    dict_items,
    has_base,
    instance_dict,
    is_own_class,
    loaded_class,
    module_members,
    name_of,
    numpy_class,
    own_text,
)
from webots_mcp.database.secret_names import LEFT_OUT, SecretNames

MOST_CHARACTERS: Final = 2_300  # of one inspection: about 3 kB with the marks of JSON
_LONGEST_TEXT: Final = 120
_LONGEST_NAME: Final = 60
_MOST_ITEMS: Final = 8
_MOST_KEYS: Final = 12
_MOST_IN_KEY: Final = 4  # items of a tuple that is a key
_MOST_ATTRIBUTES: Final = 24
_ARRAY_ITEMS: Final = 6
_OVERHEAD: Final = 8  # characters of a value in addition to its text
_LARGEST_INT: Final = 2**63
_SIGNAL_ITEMS: Final = 64  # of an array that is recorded as a signal
_AS_TEXT: Final = {  # classes of Python's library whose text shows their value, by their name
    "Decimal": "decimal", "Fraction": "fractions", "UUID": "uuid", "date": "datetime",
    "datetime": "datetime", "time": "datetime", "timedelta": "datetime", "PosixPath": "pathlib",
    "WindowsPath": "pathlib", "PurePosixPath": "pathlib", "PureWindowsPath": "pathlib",
}  # fmt: skip
_LONGEST_INT: Final = 1_000  # bits of an integer within another value: a text of it is slow

# The ids of classes that live as long as the interpreter.
_LISTS: Final = frozenset(map(id, (list, tuple, deque, set, frozenset)))
_DICTS: Final = frozenset(map(id, (dict, OrderedDict, defaultdict)))
_PLAIN: Final = frozenset(map(id, (type(None), bool, int, float, str)))
_NUMBERS: Final = frozenset(map(id, (bool, int, float)))
_CONTAINERS: Final = (dict, list, tuple, set, frozenset, deque)  # and their subclasses
_SIZED: Final = frozenset(map(id, (bytes, bytearray, range)))

_error_args = cast("Callable[[Any], Any]", vars(BaseException)["args"].__get__)


class Renderer:
    """Renders values for one inspection: each object once, within a number of characters.

    Args:
        secrets: Names whose values are left out.
        characters: How long the whole may become, about.
    """

    def __init__(self, secrets: SecretNames, characters: int = MOST_CHARACTERS) -> None:
        self._secrets = secrets
        self._left = characters
        self._seen: dict[int, tuple[str, object]] = {}  # with the object, whose id stays taken

    @property
    def is_full(self) -> bool:
        """Whether the number of characters is used up."""
        return self._left < 0

    def spend(self, characters: int) -> None:
        """Leave less space, because of what is shown next to the values."""
        self._left -= characters

    def members(
        self, found: Sequence[tuple[str, object]], depth: int, path: Callable[[str], str] = str
    ) -> dict[str, Any]:
        """Render named values, without those that find no space.

        Numbers and texts come first, so that a long list leaves them their space; the order is
        that of `found`.

        Args:
            found: Each name with its value.
            depth: How many levels of items and attributes are shown.
            path: Returns where a name's value is found.
        """
        shown: dict[str, Any] = {}
        for name, value in sorted(found, key=lambda each: id(class_of(each[1])) not in _PLAIN):
            if self.is_full:
                break
            cut_name = name[:_LONGEST_NAME]
            self._left -= len(cut_name)
            is_secret = self._secrets.has(name)
            shown[name] = LEFT_OUT if is_secret else self.render(value, depth, path(cut_name))
        return {name[:_LONGEST_NAME]: shown[name] for name, _ in found if name in shown}

    def render(self, value: object, depth: int, path: str) -> Any:
        """Render a value.

        Args:
            value: Any object.
            depth: How many levels of items and attributes are shown.
            path: Where it is found; an object that is found again refers to it.
        """
        cls = class_of(value)
        self._left -= _OVERHEAD
        if self._left < 0:
            return "..."
        kind = id(cls)
        if kind in _PLAIN:
            return self._plain(value)
        if kind in _LISTS or kind in _DICTS or is_own_class(cls):
            if (known := self._seen.get(id(value))) is not None:
                return f"(the same as {'above' if known[0] == path else known[0]})"
            self._seen[id(value)] = path, value
        if kind in _LISTS or kind in _DICTS:
            return self._container(value, cls, depth, path)
        return self._other(value, cls, depth, path)

    def _plain(self, value: Any) -> Any:
        if class_of(value) is str:
            text = value if len(value) <= _LONGEST_TEXT else f"{value[:_LONGEST_TEXT]}..."
            self._left -= len(text)
            return text
        if class_of(value) is float and not isfinite(value):
            return str(value)
        if class_of(value) is int and not -_LARGEST_INT <= value < _LARGEST_INT:
            return f"<int of {value.bit_length()} bits>"
        return value

    def _container(self, value: Any, base: Any, depth: int, path: str) -> Any:
        """Render items or entries, by the methods of the container of Python's own."""
        count = base.__len__(value)
        if depth <= 0 and count:
            return f"<{base.__name__} of {count}>"
        is_dict = issubclass(base, dict)
        try:  # in one go: between two steps of a loop another thread may change it
            most = _MOST_KEYS if is_dict else _MOST_ITEMS
            found = list(islice(dict_items(value) if is_dict else base.__iter__(value), most))
        except RuntimeError:
            return f"<{base.__name__} of {count}, which changes at this moment>"
        if not is_dict:
            return self._items(found, count, depth, path)
        names = _distinct([_key_text(key) for key, _ in found])
        entries = [(name, item) for name, (_, item) in zip(names, found, strict=True)]
        shown = self.members(entries, depth - 1, lambda name: f"{path}[{name!r}]")
        return {**shown, "...": f"{count} in all"} if count > len(shown) else shown

    def _items(self, found: list[Any], count: int, depth: int, path: str) -> list[Any]:
        shown: list[Any] = []
        for index, item in enumerate(found):
            if self.is_full:
                break
            shown.append(self.render(item, depth - 1, f"{path}[{index}]"))
        return [*shown, f"... {count} in all"] if count > len(shown) else shown

    def _other(self, value: Any, cls: type, depth: int, path: str) -> Any:
        """Render what is neither plain nor a container of Python's own."""
        for convert in (_number_or_array, _c_number_or_array, _named_thing, _text_of_known):
            if (shown := convert(value, cls)) is not None:
                self._left -= len(str(shown))
                return shown
        if depth <= 0 or not is_own_class(cls):
            return f"<{name_of(cls)}>"
        shown = {"<class>": name_of(cls)}
        if (plain := _plain_base(value, cls)) is not None:
            shown["<value>"] = self._plain(plain)
        attributes = list(islice(attributes_of(value), _MOST_ATTRIBUTES))
        members = self.members(attributes, depth - 1, lambda name: f"{path}.{name}")
        if not attributes or not has_base(cls, tuple):  # a named tuple's fields are its items
            base = next((each for each in _CONTAINERS if has_base(cls, each)), None)
            if base is not None:
                shown["<items>"] = self._container(value, base, depth - 1, path)
        return {**shown, **members}


def signal_value(value: Any) -> Any:
    """Return a value as it is recorded as a signal: numbers, flags, texts and short arrays."""
    cls = class_of(value)
    if value is None or id(cls) in _NUMBERS:
        return value
    if cls is str:
        return value[:_LONGEST_TEXT]
    if cls is numpy_class("ndarray") and value.dtype.kind in "biuf" and value.size <= _SIGNAL_ITEMS:
        return value.tolist()
    if (cls is list or cls is tuple or cls is deque) and len(value) <= _SIGNAL_ITEMS:
        items = list(value)
        if _are_numbers(items):
            return items
    if c_array_class(cls) is not None:
        items = list(islice(c_items(value), _SIGNAL_ITEMS + 1))
        if len(items) <= _SIGNAL_ITEMS and _are_numbers(items):
            return items
    if id(cls) in _LISTS or id(cls) in _DICTS:
        return f"<{cls.__name__}>"
    number = _number_or_array(value, cls)
    if number is None:
        number = _c_number_or_array(value, cls)
    if number is not None:
        return number
    plain = _plain_base(value, cls)
    return _text_of_enum(value, cls) or (f"<{name_of(cls)}>" if plain is None else plain)


# -- kinds of objects ------------------------------------------------------------------------------


def _distinct(names: list[str]) -> list[str]:
    """Return names, those that came before with a number."""
    known: Counter[str] = Counter()
    found: list[str] = []
    for name in names:
        known[name] += 1
        found.append(name if known[name] == 1 else f"{name} ({known[name]})")
    return found


def _key_text(key: Any) -> str:
    """Return the text of a dict's key: of numbers, enum members and tuples of them too."""
    cls = class_of(key)
    if cls is tuple:
        return f"({', '.join(map(_atom_text, key[:_MOST_IN_KEY]))})"
    return _atom_text(key)


def _atom_text(key: Any) -> str:
    cls = class_of(key)
    if cls is str:
        return key
    if cls is int and key.bit_length() > _LONGEST_INT:
        return f"<int of {key.bit_length()} bits>"
    if key is None or id(cls) in _NUMBERS:
        return str(key)
    number = _number_or_array(key, cls)
    if id(class_of(number)) in _NUMBERS:
        return str(number)
    return _text_of_enum(key, cls) or f"<{name_of(cls)}>"


def _are_numbers(items: list[Any]) -> bool:
    return _NUMBERS.issuperset(map(id, map(type, items)))


def _number_or_array(value: Any, cls: type) -> Any:
    if cls is complex or id(cls) in _SIZED:
        return complex.__repr__(value) if cls is complex else f"<{cls.__name__} of {len(value)}>"
    array = numpy_class("ndarray")
    if array is not None and has_base(cls, array):
        return _array(value, cls, array)
    generic = numpy_class("generic")
    if generic is None or not has_base(cls, generic):
        return None
    plain = generic.item(value)
    if id(class_of(plain)) in _NUMBERS:
        return plain if class_of(plain) is not float or isfinite(plain) else str(plain)
    if class_of(plain) is str:
        return plain[:_LONGEST_TEXT]
    return complex.__repr__(plain) if class_of(plain) is complex else f"<{name_of(cls)}>"


def _array(array: Any, cls: type, base: Any) -> str:
    """Return type and shape of an array of numpy, and its first values.

    Of a class derived from `base` only shape and type are read, with the descriptors of `base`:
    which values hold, a mask for example decides.
    """
    members = cast("Mapping[str, Any]", vars(base))
    sizes, dtype = members["shape"].__get__(array), members["dtype"].__get__(array)
    shape = " x ".join(map(str, sizes)) or "1 value"
    about = f"{'array' if cls is base else name_of(cls)} {shape} of {dtype!s:.60}"
    if cls is not base or dtype.kind not in "biuf" or not array.size:
        return f"<{about}>"
    first = ", ".join(f"{each.item():.6g}" for each in islice(array.flat, _ARRAY_ITEMS))
    return f"<{about}: {first}{', ...' if array.size > _ARRAY_ITEMS else ''}>"


def _c_number_or_array(value: Any, cls: type) -> Any:
    """Return the value of a number of ctypes, or the first ones of an array."""
    simple: Any = loaded_class("_ctypes", "_SimpleCData")
    if simple is not None and has_base(cls, simple):
        members = cast("Mapping[str, Any]", vars(simple))
        plain = members["value"].__get__(value)
        return plain if id(class_of(plain)) in _NUMBERS else f"<{name_of(cls)}>"
    if c_array_class(cls) is None:
        return None
    items = list(islice(c_items(value), _ARRAY_ITEMS + 1))
    if not _are_numbers(items):
        return f"<{name_of(cls)}>"
    first = ", ".join(f"{each:.6g}" for each in items[:_ARRAY_ITEMS])
    return f"<{name_of(cls)}: {first}{', ...' if len(items) > _ARRAY_ITEMS else ''}>"


def _named_thing(value: Any, cls: type) -> str | None:
    """Return the name of a class, function, module, generator, error or enum member."""
    if has_base(cls, type):
        return f"<class {name_of(value)}>"
    if cls is FunctionType:
        return f"<function {own_text(value.__qualname__)[:_LONGEST_TEXT]}>"
    if cls is MethodType:
        function = value.__func__
        is_function = class_of(function) is FunctionType
        named = own_text(function.__qualname__) if is_function else "of an object"
        return f"<method {named[:_LONGEST_TEXT]}>"
    if cls is BuiltinFunctionType:
        return f"<function {value.__name__}>"
    if cls is ModuleType:
        name: Any = module_members(value).get("__name__")
        return f"<module {name[:_LONGEST_NAME]}>" if class_of(name) is str else "<module>"
    if cls is GeneratorType or cls is CoroutineType:
        frame = value.gi_frame if cls is GeneratorType else value.cr_frame
        code = value.gi_code if cls is GeneratorType else value.cr_code
        at = f", at line {frame.f_lineno}" if frame is not None else ", ended"
        return f"<{name_of(cls)} {own_text(code.co_name)[:_LONGEST_NAME]}{at}>"
    if has_base(cls, BaseException):
        texts: list[Any] = [each for each in _args_of(value) if class_of(each) is str]
        return f"<{name_of(cls)}: {texts[0][:_LONGEST_TEXT]}>" if texts else f"<{name_of(cls)}>"
    return _text_of_enum(value, cls)


def _args_of(error: object) -> tuple[Any, ...]:
    args: Any = _error_args(error)
    return args if class_of(args) is tuple else ()


def _text_of_enum(value: object, cls: type) -> str | None:
    base = loaded_class("enum", "Enum")
    if base is None or not has_base(cls, base):
        return None
    members: dict[str, Any] = instance_dict(value) or {}
    if not has_text_keys(members):
        return f"<{name_of(cls)}>"
    known: list[Any] = [members.get("_name_"), members.get("_value_")]
    for name in known:  # flags may have no name
        if class_of(name) is str:
            return f"{name_of(cls)}.{name[:_LONGEST_NAME]}"
        if class_of(name) is int and name.bit_length() <= _LONGEST_INT:
            return f"{name_of(cls)}({name})"
    return f"<{name_of(cls)}>"


def _text_of_known(value: Any, cls: type) -> str | None:
    """Return the text of a class of Python's library that shows its value."""
    module = _AS_TEXT.get(name_of(cls))
    if module is None or loaded_class(module, name_of(cls)) is not cls:
        return None
    if name_of(cls) in ("datetime", "time") and value.tzinfo is not None:
        return str(value.replace(tzinfo=None))  # the zone may be a class of the user
    held: list[Any] = [each for _, each in attributes_of(value)]
    held += [item for each in held if class_of(each) is list for item in each]
    if all(map(_is_harmless, held)):
        return str(value)[:_LONGEST_TEXT]
    return f"<{name_of(cls)}>"


def _is_harmless(held: Any) -> bool:
    """Return whether what an object of Python's library holds is no number or text of the user."""
    cls = class_of(held)
    if cls is int:
        return held.bit_length() <= _LONGEST_INT
    return (
        id(cls) in _PLAIN
        or not (has_base(cls, str) or has_base(cls, int))
        or not (is_own_class(cls))
    )


def _plain_base(value: Any, cls: type) -> Any:
    """Return the plain value of a number or a text of a subclass."""
    if has_base(cls, float):
        return float.__float__(value)
    if has_base(cls, int):
        return int.__int__(value)
    return str.__str__(value) if has_base(cls, str) else None
