"""Reads classes, attributes and modules of any objects without running any code of the user.

Types are read from `type`'s own descriptors, attributes from `__dict__` and slots. Classes are
compared by identity alone, since `==`, `in` and a dict would call the metaclass of the user.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import import_module
from itertools import islice
from types import FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any, Final, cast

from webots_mcp.bridge.inspection.frames import is_own

_LONGEST_NAME: Final = 120
_MOST_ATTRIBUTES: Final = 1_000  # of one object
_C_ARRAYS: Final = (("_ctypes", "Array"), ("array", "array"))
_MOST_CLASSES: Final = 10_000  # that are remembered
_TUPLE_FIELD: Final = getattr(import_module("_collections"), "_tuplegetter", None)

_of_type = cast("Mapping[str, Any]", vars(type))
class_of = cast("Callable[[object], Any]", type)
mro_of = cast("Callable[[type], tuple[type[Any], ...]]", _of_type["__mro__"].__get__)
dict_items = cast("Callable[[Any], Iterable[tuple[Any, Any]]]", vars(dict)["items"])
_type_dict = cast("Callable[[type], Mapping[Any, Any]]", _of_type["__dict__"].__get__)
_type_name = cast("Callable[[type], str]", _of_type["__name__"].__get__)
_type_module = cast("Callable[[type], object]", _of_type["__module__"].__get__)
module_members = cast("Callable[[Any], dict[str, Any]]", vars(ModuleType)["__dict__"].__get__)

# By the ids of classes, with the class, whose id stays taken.
_own_classes: dict[int, tuple[type, bool]] = {}
_dict_getters: dict[int, tuple[type, Any]] = {}
_fields: dict[int, tuple[type, list[tuple[str, Any]]]] = {}


def has_base(cls: type, base: type) -> bool:
    """Return whether a class is `base` or inherits from it."""
    for each in mro_of(cls):  # noqa: SIM110  (a generator takes thrice the time)
        if each is base:
            return True
    return False


def name_of(cls: type) -> str:
    """Return the name of a class, whatever its metaclass answers."""
    return own_text(_type_name(cls))[:_LONGEST_NAME]


def own_text(text: str) -> str:
    """Return a text of `str` itself, of whichever subclass it is."""
    return text if class_of(text) is str else str.__str__(text)


def attributes_of(value: object) -> Iterator[tuple[str, object]]:
    """Yield the attributes that an object itself has: of its `__dict__`, then of its slots."""
    cls = class_of(value)
    own = instance_dict(value)
    for name, attribute in list(islice((own or {}).items(), _MOST_ATTRIBUTES)):
        if class_of(name) is str:
            yield name, attribute
    for name, member in _fields_of(cls):
        with suppress(AttributeError):
            yield name, field_value(member, value)


def _fields_of(cls: type) -> list[tuple[str, Any]]:
    """Return the fields of a class and its bases; each class is searched once."""
    known = _fields.get(id(cls))
    if known is not None:
        return known[1]
    found = [
        (name, member)
        for base in mro_of(cls)
        if _module_of(base) != "_ctypes"  # its own members are addresses
        for name, member in list(_type_dict(base).items())
        if class_of(name) is str and is_field(member)
    ]
    if len(_fields) < _MOST_CLASSES:
        _fields[id(cls)] = cls, found
    return found


def is_field(member: object) -> bool:
    """Return whether a class's member reads a slot, or a field of a named tuple or a C structure.

    Those are the interpreter's own: reading one runs no code of the user.
    """
    cls = class_of(member)
    if cls is FunctionType:  # the usual case
        return False
    return cls is MemberDescriptorType or cls is _TUPLE_FIELD or cls is _c_field_class()


def field_value(member: Any, value: object) -> Any:
    """Return the value of a field.

    Raises:
        AttributeError: It has none yet, or belongs to another class.
    """
    try:
        return member.__get__(value, class_of(value))
    except TypeError as error:
        raise AttributeError(str(error)) from error


def instance_dict(value: object) -> dict[Any, Any] | None:
    """Return an object's own `__dict__`; None if it has none.

    A class may define a property of that name, so only the interpreter's own descriptor is asked.
    """
    cls = class_of(value)
    known = _dict_getters.get(id(cls)) or _find_dict_getter(cls)
    if known[1] is None:
        return None
    try:
        own: Any = known[1].__get__(value, cls)
    except TypeError:  # the descriptor of another class
        return None
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


def class_members(cls: type) -> list[str]:
    """Return the names that a class and its bases define."""
    return [
        name for base in mro_of(cls) for name in list(_type_dict(base)) if class_of(name) is str
    ]


def numpy_class(name: str) -> Any:
    """Return a class of numpy; None while numpy is not imported."""
    return loaded_class("numpy", name)


def loaded_class(module: str, name: str) -> Any:
    """Return what a module defines; None while it is not imported."""
    loaded = sys.modules.get(module)
    return module_members(loaded).get(name) if class_of(loaded) is ModuleType else None


def c_array_class(cls: type) -> Any:
    """Return the array of ctypes or of the module `array` that a class is or inherits from."""
    for module, name in _C_ARRAYS:
        base: Any = loaded_class(module, name)
        if base is not None and has_base(cls, base):
            return base
    return None


def c_items(value: Any) -> Iterator[Any]:
    """Return the items of such an array."""
    base = c_array_class(class_of(value))
    return (base.__getitem__(value, index) for index in range(base.__len__(value)))


def _c_field_class() -> Any:
    """Return the class of the fields of C structures; None while ctypes is not imported."""
    structure, number = loaded_class("ctypes", "Structure"), loaded_class("ctypes", "c_int")
    return None if structure is None or number is None else _class_of_field(structure, number)


@cache
def _class_of_field(structure: Any, number: Any) -> Any:
    example = class_of(structure)("Example", (structure,), {"_fields_": [("field", number)]})
    return class_of(example.field)


def is_own_class(cls: type) -> bool:
    """Return whether a class is defined in the controller's own code; each is judged once."""
    known = _own_classes.get(id(cls))
    if known is not None:
        return known[1]
    name = _module_of(cls)
    module = sys.modules.get(name)
    file = module_members(module).get("__file__") if class_of(module) is ModuleType else None
    if class_of(file) is str:  # `isinstance` would ask an object for its `__class__`
        is_own_class = is_own(str(file))
    else:  # made by `exec`, or of the interpreter itself
        is_own_class = class_of(module) is not ModuleType or name == "__main__"
    if len(_own_classes) < _MOST_CLASSES:
        _own_classes[id(cls)] = cls, is_own_class
    return is_own_class


def _module_of(cls: type) -> str:
    module: Any = _type_module(cls)
    return module if class_of(module) is str else ""
