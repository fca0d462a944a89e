"""Values of any objects as bounded JSON, without running any code of the user.

No property, descriptor, `__getattr__`, `__repr__`, `__len__`, `__iter__` or metaclass of a class
that is not known is called: types are read from `type`'s own descriptors, attributes from
`__dict__` and slots, items by the methods of Python's own containers. Classes are compared by
identity alone, since `==`, `in` and a dict would call the metaclass of the user.
"""

from __future__ import annotations

import sys
from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import islice
from math import isfinite
from types import (
    BuiltinFunctionType,
    CoroutineType,
    FunctionType,
    GeneratorType,
    GetSetDescriptorType,
    MemberDescriptorType,
    MethodType,
    ModuleType,
)
from typing import Any, Final, cast

from webots_mcp.bridge.inspection.frames import is_own
from webots_mcp.database.secret_names import LEFT_OUT, SecretNames

MOST_CHARACTERS: Final = 3_000  # of one inspection
_LONGEST_TEXT: Final = 120
_LONGEST_NAME: Final = 60
_MOST_ITEMS: Final = 8
_MOST_KEYS: Final = 12
_MOST_ATTRIBUTES: Final = 24
_ARRAY_ITEMS: Final = 6
_OVERHEAD: Final = 8  # characters of a value besides its text
_MOST_CLASSES: Final = 10_000  # that are remembered
_LARGEST_INT: Final = 2**63
_SIGNAL_ITEMS: Final = 64  # of an array that is recorded as a signal
_AS_TEXT: Final = {  # classes of Python's library whose text shows their value
    "decimal": ("Decimal",), "fractions": ("Fraction",), "uuid": ("UUID",),
    "datetime": ("datetime", "date", "time", "timedelta"),
    "pathlib": ("PosixPath", "WindowsPath", "PurePosixPath", "PureWindowsPath"),
}  # fmt: skip

# The ids of classes that live as long as the interpreter.
_LISTS: Final = frozenset(map(id, (list, tuple, deque, set, frozenset)))
_DICTS: Final = frozenset(map(id, (dict, OrderedDict, defaultdict)))
_PLAIN: Final = frozenset(map(id, (type(None), bool, int, float, str)))
_NUMBERS: Final = frozenset(map(id, (bool, int, float)))
_SIZED: Final = frozenset(map(id, (bytes, bytearray, range)))

_of_type = cast("Mapping[str, Any]", vars(type))
class_of = cast("Callable[[object], type[Any]]", type)
mro_of = cast("Callable[[type], tuple[type[Any], ...]]", _of_type["__mro__"].__get__)
dict_items = cast("Callable[[Any], Iterable[tuple[Any, Any]]]", vars(dict)["items"])
_type_dict = cast("Callable[[type], Mapping[Any, Any]]", _of_type["__dict__"].__get__)
_type_name = cast("Callable[[type], str]", _of_type["__name__"].__get__)
_type_module = cast("Callable[[type], object]", _of_type["__module__"].__get__)
_module_dict = cast("Callable[[Any], dict[str, Any]]", vars(ModuleType)["__dict__"].__get__)


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

    def named(self, name: str, value: object, depth: int, path: str = "") -> Any:
        """Render a value that has a name, unless that looks secret."""
        if self._secrets.has(name):
            return LEFT_OUT
        return self.render(value, depth, path or name)

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
        if kind in _LISTS or kind in _DICTS or _is_own_class(cls):
            if (known := self._seen.get(id(value))) is not None:
                return f"(the same as {known[0]})"
            self._seen[id(value)] = path, value
        if kind in _LISTS:
            return self._items(value, cls, depth, path)
        if kind in _DICTS:
            return self._entries(value, cls, depth, path)
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

    def _items(self, value: Any, cls: type, depth: int, path: str) -> Any:
        count = len(value)
        if depth <= 0 and count:
            return f"<{cls.__name__} of {count}>"
        shown = [
            self.render(item, depth - 1, f"{path}[{index}]")
            for index, item in enumerate(islice(cast("Iterable[Any]", value), _MOST_ITEMS))
        ]
        return [*shown, f"... {count} in all"] if count > _MOST_ITEMS else shown

    def _entries(self, value: Any, cls: type, depth: int, path: str) -> Any:
        count = len(value)
        if depth <= 0 and count:
            return f"<{cls.__name__} of {count}>"
        shown: dict[str, Any] = {}
        for key, item in islice(dict_items(value), _MOST_KEYS):
            is_shown = class_of(key) is str or id(class_of(key)) in _NUMBERS
            name = str(key)[:_LONGEST_NAME] if is_shown else f"<{name_of(class_of(key))}>"
            shown[name] = self.named(name, item, depth - 1, f"{path}[{name!r}]")
        return {**shown, "...": f"{count} in all"} if count > _MOST_KEYS else shown

    def _other(self, value: Any, cls: type, depth: int, path: str) -> Any:
        """Render what is neither plain nor a container of Python's own."""
        for convert in (_number_or_array, _named_thing, _text_of_known):
            if (shown := convert(value, cls)) is not None:
                self._left -= len(str(shown))
                return shown
        if depth <= 0 or not _is_own_class(cls):
            return f"<{name_of(cls)}>"
        shown = {"<class>": name_of(cls)}
        if (plain := _plain_base(value, cls)) is not None:
            shown["<value>"] = self._plain(plain)
        for name, attribute in islice(attributes_of(value), _MOST_ATTRIBUTES):
            shown[name[:_LONGEST_NAME]] = self.named(name, attribute, depth - 1, f"{path}.{name}")
        return shown


def has_base(cls: type, base: type) -> bool:
    """Return whether a class is `base` or inherits from it."""
    return any(each is base for each in mro_of(cls))


def name_of(cls: type) -> str:
    """Return the name of a class, whatever its metaclass answers."""
    return _type_name(cls)


def attributes_of(value: object) -> Iterator[tuple[str, object]]:
    """Yield the attributes that an object itself has: of its `__dict__`, then of its slots."""
    cls = class_of(value)
    own = instance_dict(value)
    for name, attribute in list(own.items()) if own is not None else ():
        if class_of(name) is str:
            yield name, attribute
    for base in mro_of(cls):
        for name, member in _type_dict(base).items():
            if class_of(member) is MemberDescriptorType and class_of(name) is str:
                try:
                    yield name, member.__get__(value, cls)
                except AttributeError:  # a slot without a value
                    continue


def instance_dict(value: object) -> dict[Any, Any] | None:
    """Return an object's own `__dict__`; None if it has none.

    A class may define a property of that name, so only the interpreter's own descriptor is asked.
    """
    cls = class_of(value)
    known = _dict_getters.get(id(cls)) or _find_dict_getter(cls)
    if known[1] is None:
        return None
    own: Any = known[1].__get__(value, cls)
    return own if class_of(own) is dict else None


def _find_dict_getter(cls: type) -> tuple[type, Any]:
    members = (_type_dict(base).get("__dict__") for base in mro_of(cls))
    found = cls, next((each for each in members if class_of(each) is GetSetDescriptorType), None)
    if len(_dict_getters) < _MOST_CLASSES:
        _dict_getters[id(cls)] = found
    return found


def class_member(cls: type, name: str) -> Any:
    """Return what a class or its bases define under a name.

    Raises:
        KeyError: None of them does.
    """
    for base in mro_of(cls):
        members = _type_dict(base)
        if name in members:
            return members[name]
    raise KeyError(name)


def signal_value(value: Any) -> Any:
    """Return a value as it is recorded as a signal: numbers, flags, texts and short arrays."""
    cls = class_of(value)
    if value is None or id(cls) in _NUMBERS:
        return value
    if cls is str:
        return value[:_LONGEST_TEXT]
    if (array := numpy_class("ndarray")) is not None and cls is array:
        is_short = value.dtype.kind in "biuf" and value.size <= _SIGNAL_ITEMS
        return value.tolist() if is_short else _array(value)
    if (cls is list or cls is tuple) and len(value) <= _SIGNAL_ITEMS:
        items = list(value)
        if all(id(class_of(each)) in _NUMBERS for each in items):
            return items
    number = _number_or_array(value, cls)
    if number is not None:
        return number
    plain = _plain_base(value, cls)
    return _text_of_enum(value, cls) or (f"<{name_of(cls)}>" if plain is None else plain)


# -- kinds of objects ------------------------------------------------------------------------------


def _number_or_array(value: Any, cls: type) -> Any:
    if cls is complex or id(cls) in _SIZED:
        return complex.__repr__(value) if cls is complex else f"<{cls.__name__} of {len(value)}>"
    if (array := numpy_class("ndarray")) is not None and cls is array:
        return _array(value)
    generic = numpy_class("generic")
    if generic is not None and has_base(cls, generic):
        plain = generic.item(value)
        if id(class_of(plain)) in _NUMBERS:
            return plain if class_of(plain) is not float or isfinite(plain) else str(plain)
        return f"<{name_of(cls)}>"
    return None


def _array(array: Any) -> str:
    """Return type and shape of an array of numpy, and its first values."""
    shape = " x ".join(map(str, array.shape)) or "1 value"
    if array.dtype.kind not in "biuf":
        return f"<array {shape} of {array.dtype}>"
    first = ", ".join(f"{each.item():.6g}" for each in islice(array.flat, _ARRAY_ITEMS))
    more = ", ..." if array.size > _ARRAY_ITEMS else ""
    return f"<array {shape} of {array.dtype}: {first}{more}>"


def numpy_class(name: str) -> Any:
    """Return a class of numpy; None while numpy is not imported."""
    numpy = sys.modules.get("numpy")
    return _module_dict(numpy).get(name) if class_of(numpy) is ModuleType else None


def _named_thing(value: Any, cls: type) -> str | None:
    """Return the name of a class, function, module, generator or enum member."""
    if has_base(cls, type):
        return f"<class {name_of(value)}>"
    if cls is FunctionType:
        return f"<function {value.__qualname__}>"
    if cls is MethodType:
        function = value.__func__
        named = function.__qualname__ if class_of(function) is FunctionType else "of an object"
        return f"<method {named}>"
    if cls is BuiltinFunctionType:
        return f"<function {value.__name__}>"
    if cls is ModuleType:
        return f"<module {_module_dict(value).get('__name__')!s:.60}>"
    if cls is GeneratorType or cls is CoroutineType:
        frame = value.gi_frame if cls is GeneratorType else value.cr_frame
        code = value.gi_code if cls is GeneratorType else value.cr_code
        at = f", at line {frame.f_lineno}" if frame is not None else ", ended"
        return f"<{name_of(cls)} {code.co_name}{at}>"
    return _text_of_enum(value, cls)


def _text_of_enum(value: object, cls: type) -> str | None:
    enum = sys.modules.get("enum")
    base = _module_dict(enum).get("Enum") if class_of(enum) is ModuleType else None
    if base is None or not has_base(cls, base):
        return None
    name = (instance_dict(value) or {}).get("_name_")
    return f"{name_of(cls)}.{name}" if class_of(name) is str else f"<{name_of(cls)}>"


def _text_of_known(value: object, cls: type) -> str | None:
    """Return the text of a class of Python's library that shows its value."""
    module = _module_of(cls)
    if name_of(cls) in _AS_TEXT.get(module, ()):
        loaded = sys.modules.get(module)
        if class_of(loaded) is ModuleType and _module_dict(loaded).get(name_of(cls)) is cls:
            return str(value)[:_LONGEST_TEXT]
    return None


def _plain_base(value: Any, cls: type) -> Any:
    """Return the plain value of a number or a text of a subclass."""
    if has_base(cls, float):
        return float.__float__(value)
    if has_base(cls, int):
        return int.__int__(value)
    return str.__str__(value) if has_base(cls, str) else None


# By the ids of classes, with the class, whose id stays taken.
_own_classes: dict[int, tuple[type, bool]] = {}
_dict_getters: dict[int, tuple[type, Any]] = {}


def _is_own_class(cls: type) -> bool:
    """Return whether a class is defined in the controller's own code; each is judged once."""
    known = _own_classes.get(id(cls))
    if known is not None:
        return known[1]
    name = _module_of(cls)
    module = sys.modules.get(name)
    file = _module_dict(module).get("__file__") if class_of(module) is ModuleType else None
    if isinstance(file, str):
        is_own_class = is_own(file)
    else:  # made by `exec`, or of the interpreter itself
        is_own_class = class_of(module) is not ModuleType or name == "__main__"
    if len(_own_classes) < _MOST_CLASSES:
        _own_classes[id(cls)] = cls, is_own_class
    return is_own_class


def _module_of(cls: type) -> str:
    module = _type_module(cls)
    return module if isinstance(module, str) else ""
