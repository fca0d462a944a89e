"""Dotted paths to a controller's variables, such as `self.pid.integral` or `path[3]['x']`.

A path begins with a variable of the innermost of the controller's own frames that has it, or with
a name of a module. Following it runs no code of the user: see `values`.
"""

from __future__ import annotations

import re
from collections import deque
from itertools import islice
from types import FunctionType, MemberDescriptorType
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.inspection.frames import OwnFrame, has_text_keys
from webots_mcp.bridge.inspection.values import (
    attributes_of,
    class_member,
    class_of,
    dict_items,
    has_base,
    instance_dict,
    name_of,
    numpy_class,
)
from webots_mcp.database.secret_names import SecretNames
from webots_mcp.errors import InvalidInputError

MOST_CHARACTERS: Final = 200
_NAME: Final = r"\s*([^\W\d]\w*)"
_PART: Final = r"\s*(?:\.\s*([^\W\d]\w*)|\[\s*(-?\d{1,9}|'[^']*'|\"[^\"]*\")\s*\])"
_MOST_KEYS: Final = 1000  # of a dict: all of them may have to be compared
_MOST_NAMED: Final = 8
_TEXT_OR_INT: Final = frozenset(map(id, (str, int)))
_EXAMPLES: Final = "such as self.pid.integral, path[3] or table['x']"


class AttributePath(NamedTuple):
    """A path that was parsed.

    Attributes:
        text: As it was given, without spaces at its ends.
        root: The variable that it begins with.
        steps: An attribute's name (True), or a key or an index (False).
    """

    text: str
    root: str
    steps: tuple[tuple[bool, str | int], ...]


class PathEndsError(Exception):
    """A path cannot be followed to its end."""


def parse_path(text: object, secrets: SecretNames) -> AttributePath:
    """Parse a path.

    Raises:
        InvalidInputError: It is no path, too long, or a name in it looks secret.
    """
    if not isinstance(text, str) or len(text) > MOST_CHARACTERS:
        raise InvalidInputError(
            f"path must be a text of at most {MOST_CHARACTERS} characters, {_EXAMPLES}"
        )
    text = text.strip()
    root = re.match(_NAME, text)
    if root is None:
        raise InvalidInputError(f"{text!r} does not begin with the name of a variable; {_EXAMPLES}")
    at, steps = root.end(), list[tuple[bool, str | int]]()
    while at < len(text):
        part = re.compile(_PART).match(text, at)
        if part is None:
            raise InvalidInputError(
                f"{text!r} is no path from its character {at + 1} on: it is made of names, .name, "
                f"[3] and ['key'], {_EXAMPLES}"
            )
        name, key = part.groups()
        if name:
            steps.append((True, name))
        else:
            steps.append((False, key[1:-1] if key[0] in "'\"" else int(key)))
        at = part.end()
    for name in (root.group(1), *(str(step) for _, step in steps)):
        if secrets.has(name):
            raise InvalidInputError(f"{name!r} looks secret, so its value is not shown")
    return AttributePath(text, root.group(1), tuple(steps))


def find_root(path: AttributePath, frames: list[OwnFrame]) -> Any:
    """Return the variable that a path begins with.

    Raises:
        PathEndsError: No frame has it.
    """
    for each in frames:
        if path.root in (names := each.variables):
            return names[path.root]
    for each in frames:
        if path.root in (names := each.module_variables):
            return names[path.root]
    if not frames:
        raise PathEndsError("no code of the controller is being executed")
    names = (name for name in frames[0].variables if not name.startswith("__"))
    known = ", ".join(sorted(names)[:_MOST_NAMED])
    where = frames[0].frame.f_code.co_name
    raise PathEndsError(f"there is no variable {path.root!r}; {where} has {known or 'none'}")


def follow(path: AttributePath, value: Any) -> Any:
    """Return the value at the end of a path, from the variable that it begins with.

    Raises:
        PathEndsError: An attribute or item is not there, or reading it would run code.
    """
    for is_name, key in path.steps:
        value = _attribute(value, str(key)) if is_name else _item(value, key)
    return value


def _attribute(value: Any, name: str) -> Any:
    own, cls = instance_dict(value), class_of(value)
    if own is not None:
        if has_text_keys(own):
            if name in own:
                return own[name]
        else:
            for each, found in attributes_of(value):
                if each == name:
                    return found
    try:
        member = class_member(cls, name)
    except KeyError:
        raise PathEndsError(_no_attribute(value, name)) from None
    if class_of(member) is MemberDescriptorType:
        try:
            return member.__get__(value, cls)
        except AttributeError:
            raise PathEndsError(f"{name!r} of {name_of(cls)} has no value yet") from None
    if _has_getter(class_of(member)) and class_of(member) is not FunctionType:
        raise PathEndsError(
            f"{name!r} of {name_of(cls)} is computed ({name_of(class_of(member))}): reading it "
            "would run code of the controller"
        )
    return member


def _has_getter(cls: type) -> bool:
    try:
        class_member(cls, "__get__")
    except KeyError:
        return False
    return True


def _no_attribute(value: Any, name: str) -> str:
    names = [each for each, _ in attributes_of(value)][:_MOST_NAMED]
    has = f"; it has {', '.join(names)}" if names else ""
    return f"{name_of(class_of(value))} has no {name!r}{has}"


def _item(value: Any, key: str | int) -> Any:
    cls = class_of(value)
    if has_base(cls, dict):
        return _entry(value, key)
    sequence: Any = next((each for each in (list, tuple, deque) if has_base(cls, each)), None)
    array = numpy_class("ndarray")
    if sequence is None and array is not None and cls is array:
        sequence = array
    if sequence is None:
        raise PathEndsError(f"[{key!r}] of {name_of(cls)} would run code of the controller")
    count = sequence.__len__(value) if sequence is not array or value.ndim else 0
    if not isinstance(key, int) or not -count <= key < count:
        raise PathEndsError(f"there is no [{key!r}] in a {name_of(cls)} of {count}")
    return sequence.__getitem__(value, key)


def _entry(value: Any, key: str | int) -> Any:
    """Return the value of a key; each is compared, since a look-up may call a key's `__eq__`."""
    count = sum(1 for _ in islice(dict_items(value), _MOST_KEYS + 1))
    if count > _MOST_KEYS:
        raise PathEndsError(f"a dict of over {_MOST_KEYS} entries is too large")
    for each, found in dict_items(value):
        if class_of(each) is class_of(key) and each == key:
            return found
    keys = [repr(each) for each, _ in dict_items(value) if id(class_of(each)) in _TEXT_OR_INT]
    has = f"; it has {', '.join(keys[:_MOST_NAMED])}" if keys else ""
    raise PathEndsError(f"there is no [{key!r}] in a {name_of(class_of(value))}{has}")
