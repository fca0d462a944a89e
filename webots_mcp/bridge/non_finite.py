"""NaN and infinities at paths where earlier states had them, replaced without the cleaner.

A wheel in velocity mode has an infinite target position in each row, and a lidar has infinities
where nothing is in its range. The cleaner finds them, their paths are remembered, and later states
are searched only there. At any other path the encoder fails, and the cleaner finds that one too.

The paths of all robots of the process are kept together. A path that a state does not have costs
one look-up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Final, NamedTuple, cast

from webots_mcp.bridge.json_cleaning import replace_non_finite
from webots_mcp.bridge.plain_values import NotPlainError

_KINDS: Final = frozenset(("nan", "inf", "-inf"))


class KnownPathLimits(NamedTuple):
    """Limits of the paths that are remembered.

    Attributes:
        paths: Number of paths.
        characters: Length of a path.
    """

    paths: int = 64
    characters: int = 500


_LIMITS: Final = KnownPathLimits()


class _PathTree:
    """The remembered paths below one key.

    Attributes:
        path: The keys from the top of the state to this one, with dots between them.
        below: The next keys, where a dict stands at this path.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self.below: dict[str, _PathTree] = {}


_paths = _PathTree("")
_path_count = 0


def remember_non_finite(state: object, replaced: dict[str, str]) -> None:
    """Remember the paths at which a state has numbers that are not finite.

    Args:
        state: The state as it was published.
        replaced: All that the cleaner replaced in it.
    """
    global _paths, _path_count
    if not replaced or state.__class__ is not dict or not _KINDS.issuperset(replaced.values()):
        return  # a state with other replacements has to be cleaned anyway
    found = list(_find_non_finite(cast("dict[object, object]", state), (), 0))
    if len(found) > _LIMITS.paths:
        return
    if _path_count + len(found) > _LIMITS.paths:
        _paths, _path_count = _PathTree(""), 0
    for keys in found:
        tree = _paths
        for depth, key in enumerate(keys, 1):
            if key not in tree.below:  # a new dict, since another thread may read the old one
                tree.below = {**tree.below, key: _PathTree(".".join(keys[:depth]))}
            tree = tree.below[key]
        _path_count += 1


def without_non_finite(state: object, replaced: dict[str, str]) -> tuple[object, int]:
    """Return a state with null for the numbers at remembered paths that are not finite.

    Args:
        state: A plain state, which is not changed.
        replaced: Receives dotted path to kind, as the cleaner would name it.

    Returns:
        The state, copied where it had to be changed, and the number of nulls put into it.

    Raises:
        NotPlainError: If more has to be named than is remembered.
    """
    if not _path_count or state.__class__ is not dict:
        return state, 0
    return _replace(cast("dict[str, Any]", state), _paths, replaced)


def _find_non_finite(
    values: dict[Any, Any], above: tuple[str, ...], characters: int
) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        if type(key) is not str:
            continue
        path_characters = characters + len(key) + 1
        if path_characters > _LIMITS.characters:
            continue
        kind: Any = value.__class__
        if kind is dict:
            yield from _find_non_finite(value, (*above, key), path_characters)
        elif kind is float:
            if not math.isfinite(value):
                yield (*above, key)
        elif _is_plain_array(value) and not all(map(math.isfinite, value)):
            yield (*above, key)


def _is_plain_array(value: object) -> bool:
    """Return whether a value is a list or a tuple of Python's own numbers."""
    return value.__class__ in (list, tuple) and {float, int}.issuperset(
        map(type, cast("list[object]", value))
    )


def _replace(
    values: dict[str, Any], tree: _PathTree, replaced: dict[str, str]
) -> tuple[dict[str, Any], int]:
    copy, null_count = values, 0
    for key, under in tree.below.items():
        value: Any = values.get(key)
        kind: Any = value.__class__
        if kind is float:
            if value - value == 0.0:
                continue
            plain, count = None, 1
            _name(replaced, [(under.path, str(value))])
        elif kind is dict:
            plain, count = _replace(value, under, replaced)
        elif _is_plain_array(value):
            plain, names = replace_non_finite(cast("list[Any]", value))
            _name(replaced, [(f"{under.path}.{item}", what) for item, what in names])
            count = plain.count(None) if names else 0
        else:
            continue
        if count:
            if copy is values:
                copy = dict(values)
            copy[key] = plain
            null_count += count
    return copy, null_count


def _name(replaced: dict[str, str], names: list[tuple[str, str]]) -> None:
    """Name what was replaced.

    Raises:
        NotPlainError: If there are many, or two places have one path, which the cleaner counts.
    """
    expected = len(replaced) + len(names)
    if expected > _LIMITS.paths:
        raise NotPlainError
    replaced.update(names)
    if len(replaced) != expected:
        raise NotPlainError
