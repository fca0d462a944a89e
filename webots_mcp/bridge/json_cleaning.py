"""Copies of values that JSON can hold, within limits of depth, items and bytes.

The cleaner replaces what JSON cannot hold, cuts what is too large, and names every such place in
`replaced`, which becomes the column of that name:

    replaced             the value was                                           stored
    nan, inf, -inf       not a finite number                                     null
    too large            an array or a nested dict of more items than are left   null
                         a state of more keys than are left                      its first 1,000
                         a text of more than 100,000 bytes, a long key           its beginning
                         bytes over 1,024, an integer beyond all floats          null
                         an object, after others took 10 ms to read              null
    too deep             nested over 20 levels                                   null
    unsupported: bytes   bytes                                                   base64 text
    unsupported: str     a text or key with a lone surrogate                     with "?" for it
    unsupported: TYPE    a pointer, an object without counterpart, or one that   null
                         raises while it is read
                         a key that has no text                                  "<TYPE>"

A path names keys and indexes with dots between them. `lidar.*` stands for every null in an array of
numbers, and the empty path for the state itself or for the places that were not named: "4000 more".

Values are copied breadth first. Where a state has more items than a row has space for, the levels
near the top are complete and the deepest are cut. A state that contains itself ends at the limit of
depth.
"""

from __future__ import annotations

import enum
import math
import time
from collections import deque
from collections.abc import Iterable, Mapping
from itertools import compress, islice
from json.encoder import encode_basestring
from operator import not_
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.bridge.conversion import (
    MAX_ITEMS,
    TooLargeError,
    UnsupportedError,
    convert,
    item_count,
    type_name,
)

MAX_DEPTH: Final = 20
CONTAINER_ITEMS: Final = 10  # a dict or list takes as long as ten of its items, and counts as such
MAX_KEY_CHARACTERS: Final = 200
MAX_NAMED: Final = 1000  # paths in `replaced`
KEYS_OF_CUT_STATE: Final = 1000
# For all objects of a row together, since reading them runs code of unknown cost. It is processor
# time, because by the wall clock another process that runs in between would cost values.
OBJECTS_BUDGET_S: Final = 0.01
TOO_LARGE: Final = "too large"
TOO_DEEP: Final = "too deep"
BYTES_AS_TEXT: Final = "unsupported: bytes"
TEXT_WITH_SURROGATES: Final = "unsupported: str"

# Where a value is. It is a linked list, since most places are never named and need no text.
_Path: TypeAlias = "tuple[_Path | None, str | int]"


class CleanedSizes(NamedTuple):
    """Limits of what a state may hold, so that a row stays below 1,000,000 bytes.

    Attributes:
        text_bytes: Size of one text as JSON.
        texts_bytes: Size of all texts of a row.
        keys_bytes: Size of all keys of a row. 20,000 items of 28 bytes, all texts and all keys are
            1,000,000 bytes.
        blob_bytes: Size of bytes that are stored as text.
        paths_characters: Characters of all paths in `replaced`.
        escape_bytes: Bytes of JSON for one character, as in \u0000.
        key_bits: Size of an integer as a key; the text of a longer one takes long to make.
    """

    text_bytes: int = 100_000
    texts_bytes: int = 300_000
    keys_bytes: int = 140_000
    blob_bytes: int = 1024
    paths_characters: int = 50_000
    escape_bytes: int = 6
    key_bits: int = 1000


_SIZES: Final = CleanedSizes()


class _Unfilled(NamedTuple):
    """A copied container whose items are still to be copied."""

    copy: dict[str, object] | list[object]
    type_name: str
    items: Iterable[Any]
    path: _Path
    depth: int


class Cleaner:
    """Copies one state and names what it had to replace or to cut.

    Attributes:
        replaced: Maps dotted paths to what stood there.
        unnamed: Number of further places that `replaced` does not name.
    """

    def __init__(self) -> None:
        self.replaced: dict[str, str] = {}
        self.unnamed = 0
        self._items_left = MAX_ITEMS
        self._texts_bytes_left = _SIZES.texts_bytes
        self._keys_bytes_left = _SIZES.keys_bytes
        self._paths_characters_left = _SIZES.paths_characters
        self._objects_until_s = time.thread_time() + OBJECTS_BUDGET_S
        self._unfilled: deque[_Unfilled] = deque()

    def clean(self, state: object) -> object:
        """Return the plain copy of any value; a part that cannot be read costs no other part."""
        cleaned = self._clean(state, (None, ""), 0)
        while self._unfilled:
            self._fill(self._unfilled.popleft())
        if self.unnamed:
            named = self.replaced.get("")
            more = f"{self.unnamed} more"
            self.replaced[""] = f"{named}; {more}" if named else more
        return cleaned

    def _clean(self, value: Any, path: _Path, depth: int) -> object:
        try:
            return self._copy(value, path, depth)
        except UnsupportedError as error:
            self._name(path, f"unsupported: {error.type_name}")
        except TooLargeError:
            self._name(path, TOO_LARGE)
        except Exception:  # noqa: BLE001  (the user's objects may raise anything)
            self._name(path, f"unsupported: {type_name(value)}")
        return None

    def _copy(self, value: Any, path: _Path, depth: int) -> object:
        kind = type(value)  # pyright: ignore[reportUnknownVariableType]
        if value is None or kind is bool:
            return value
        if isinstance(value, int):
            return value if kind is int and -(2**63) <= value < 2**63 else _clean_integer(value)
        if isinstance(value, float):
            if math.isfinite(value):
                return float(value)
            self._name(path, str(float(value)))
            return None
        if isinstance(value, str):
            return self._clean_text(value, path)
        if depth >= MAX_DEPTH:
            self._name(path, TOO_DEEP)
            return None
        if kind is dict or isinstance(value, Mapping):
            return self._copy_mapping(cast("Mapping[object, object]", value), path, depth)
        if isinstance(value, (list, tuple, set, frozenset, deque)):
            return self._copy_items(cast("Iterable[object]", value), path, depth)
        if isinstance(value, (bytes, bytearray, memoryview)):
            return self._encode_bytes(memoryview(cast("bytes", value)), path)
        self._require_time()
        self._require_items(item_count(value))
        return self._copy(convert(value), path, depth + 1)

    # -- texts ---------------------------------------------------------------------------------

    def _clean_text(self, value: str, path: _Path) -> str:
        if isinstance(value, enum.Enum):
            value = str(value.value)
        most_bytes = min(_SIZES.text_bytes, self._texts_bytes_left)
        text = _without_surrogates(value[:most_bytes])
        if (size_bytes := _json_bytes(text)) > most_bytes:
            text = text[: most_bytes // _SIZES.escape_bytes]
            size_bytes = _json_bytes(text)
        self._texts_bytes_left -= size_bytes
        if text != value:
            self._name(path, TEXT_WITH_SURROGATES if len(text) == len(value) else TOO_LARGE)
        return text

    def _encode_bytes(self, value: memoryview, path: _Path) -> str:
        if value.nbytes > _SIZES.blob_bytes:
            raise TooLargeError
        import base64  # only here: few states hold bytes

        text = base64.b64encode(value.tobytes()).decode("ascii")
        if len(text) > self._texts_bytes_left:
            raise TooLargeError
        self._texts_bytes_left -= len(text)
        self._name(path, BYTES_AS_TEXT)
        return text

    # -- dicts ---------------------------------------------------------------------------------

    def _copy_mapping(self, value: Mapping[Any, Any], path: _Path, depth: int) -> object:
        pairs: Iterable[Any]
        count = len(value)
        if not depth and count > self._items_left - CONTAINER_ITEMS:
            count = KEYS_OF_CUT_STATE
            self._name(path, TOO_LARGE)
            pairs = islice(value.items(), count)
        elif type(value) is dict:
            pairs = cast("Iterable[Any]", value.items())
        else:
            self._require_items(count)
            pairs = self._pairs_of(value, path)
            count = len(pairs)
        self._take_items(count)
        copy: dict[str, object] = {}
        self._unfilled.append(
            _Unfilled(copy, type_name(cast("object", value)), pairs, path, depth + 1)
        )
        return copy

    def _pairs_of(self, value: Mapping[object, object], path: _Path) -> list[tuple[Any, Any]]:
        """Return the items of a user's own mapping up to one that fails.

        The items need not be as many as `len` reports, and may never end. Where there are many
        more, as many are returned as `len` reports. The others count as items of the row too, so
        that a row with many such mappings ends.
        """
        count = len(value)
        most = min(max(count, KEYS_OF_CUT_STATE), self._items_left - CONTAINER_ITEMS)
        pairs: list[tuple[Any, Any]] = []
        try:
            pairs.extend((key, item) for key, item in islice(value.items(), most + 1))
        except Exception:  # noqa: BLE001  (the user's mapping may raise anything)
            self._name(path, f"unsupported: {type_name(value)}")
        if len(pairs) > most:
            del pairs[count:]
            self._items_left -= max(most - count, 0)
            self._name(path, TOO_LARGE)
        return pairs

    # -- arrays --------------------------------------------------------------------------------

    def _copy_items(self, value: Iterable[object], path: _Path, depth: int) -> object:
        self._require_items(count := item_count(value))
        items: list[Any] = list(islice(value, count))
        self._take_items(len(items))
        kinds = set(map(type, items))
        if _are_numbers(items, kinds):
            plain, names = replace_non_finite(_plain_numbers(items, kinds))
            for name, kind in names:
                self._name((path, name), kind)
            return plain
        if _count_nested(items) - len(items) > self._items_left:
            raise TooLargeError  # as a whole, so that no image or map is stored in part
        copy: list[object] = []
        self._unfilled.append(_Unfilled(copy, type_name(value), items, path, depth + 1))
        return copy

    # -- items of containers -------------------------------------------------------------------

    def _fill(self, unfilled: _Unfilled) -> None:
        copy, name, items, path, depth = unfilled
        try:
            if isinstance(copy, dict):
                self._fill_dict(copy, items, path, depth)
            else:
                copy.extend(self._clean(item, (path, i), depth) for i, item in enumerate(items))
        except Exception:  # noqa: BLE001  (another thread may change the user's dict)
            self._name(path, f"unsupported: {name}")

    def _fill_dict(
        self, copy: dict[str, object], items: Iterable[Any], path: _Path, depth: int
    ) -> None:
        for key, item in items:
            name = self._clean_key(key, path)
            self._keys_bytes_left -= _json_bytes(name)
            if self._keys_bytes_left < 0:
                self._name(path, TOO_LARGE)
                return
            copy[name] = self._clean(item, (path, name), depth)

    def _clean_key(self, key: object, path: _Path) -> str:
        try:
            text = key_text(key)
        except Exception:  # noqa: BLE001  (the user's key may raise anything)
            name, kind = f"<{type_name(key)}>", f"unsupported: {type_name(key)}"
        else:
            name = _without_surrogates(text[:MAX_KEY_CHARACTERS])
            if name == text:
                return name
            kind = TOO_LARGE if len(text) > MAX_KEY_CHARACTERS else TEXT_WITH_SURROGATES
        self._name((path, name), kind)
        return name

    # -- limits --------------------------------------------------------------------------------

    def _require_items(self, count: int) -> None:
        if count + CONTAINER_ITEMS > self._items_left:
            raise TooLargeError

    def _take_items(self, count: int) -> None:
        self._require_items(count)
        self._items_left -= count + CONTAINER_ITEMS

    def _require_time(self) -> None:
        if time.thread_time() > self._objects_until_s:
            raise TooLargeError

    def _name(self, path: _Path, kind: str) -> None:
        if (
            len(self.replaced) + self.unnamed < MAX_NAMED
            and len(text := _path_text(path)) <= self._paths_characters_left
            and text not in self.replaced  # as {"a.b": NaN, "a": {"b": NaN}} has it
        ):
            self._paths_characters_left -= len(text)
            self.replaced[text] = kind
        else:
            self.unnamed += 1


def replace_non_finite(items: list[Any]) -> tuple[list[Any], list[tuple[str | int, str]]]:
    """Replace the numbers of an array that are not finite, without a call for each number.

    Returns:
        The items with null for such numbers, and pairs of index and kind that name them. If all
        of them are of one kind, the only pair is ("*", kind).
    """
    finite = list(map(math.isfinite, items))
    kinds = set(map(str, compress(items, map(not_, finite))))
    if not kinds:
        return items, []
    plain = [item if good else None for item, good in zip(items, finite, strict=True)]
    if len(kinds) == 1:
        return plain, [("*", kinds.pop())]
    return plain, [(i, str(item)) for i, item in compress(enumerate(items), map(not_, finite))]


def key_text(key: object) -> str:
    """Return a key of an object as the JSON encoder writes it, and any other key as its text.

    Raises:
        TooLargeError: If making the text would take long.
        Exception: Whatever the key raises while its text is made.
    """
    if key is None or isinstance(key, bool):
        return {None: "null", True: "true", False: "false"}[key]
    if isinstance(key, str):
        return str.__str__(key)  # an enum's own text is another one
    if isinstance(key, int):
        if key.bit_length() > _SIZES.key_bits:
            raise TooLargeError
        return int.__repr__(key)
    is_group = issubclass(type(key), (tuple, frozenset))
    if is_group and len(cast("tuple[object, ...]", key)) > MAX_KEY_CHARACTERS:
        raise TooLargeError
    return str(key)


def _path_text(path: _Path) -> str:
    names: list[str] = []
    above, name = path
    while above is not None:
        names.append(str(name))
        above, name = above
    return ".".join(reversed(names))


def _clean_integer(value: int) -> int | float:
    """Return an integer, or the nearest float if it is beyond 64 bits, as SQLite would read it."""
    plain = int(value)
    if -(2**63) <= plain < 2**63:
        return plain
    try:
        return float(plain)
    except OverflowError:
        raise TooLargeError from None


def _are_numbers(items: list[Any], kinds: set[type]) -> bool:
    """Return whether all items are numbers, and no integer is beyond 64 bits."""
    if not kinds or not all(issubclass(kind, (float, int)) for kind in kinds):
        return False
    if not any(issubclass(kind, int) for kind in kinds):
        return True
    return all(isinstance(item, float) or -(2**63) <= item < 2**63 for item in items)


def _plain_numbers(items: list[Any], kinds: set[type]) -> list[Any]:
    """Return numbers as Python's own types where they are of a subclass (numpy's, enums)."""
    if kinds <= {float, int, bool}:
        return items
    return [
        float(item) if isinstance(item, float) else item if isinstance(item, bool) else int(item)
        for item in items
    ]


def _count_nested(items: list[Any]) -> int:
    """Return the number of items of a list of lists of equal length, judged by the first ones."""
    total = count = len(items)
    for _ in range(MAX_DEPTH):
        if not _are_equal_lists(items):
            break
        items = cast("list[Any]", items[0])
        count *= len(items)
        total += count
    return total


def _are_equal_lists(items: list[Any]) -> bool:
    if not items or not all(isinstance(item, (list, tuple)) for item in items):
        return False
    return len(set(map(len, items))) == 1


def _json_bytes(text: str) -> int:
    """Return the size of a text in JSON, without its quotes."""
    quoted = encode_basestring(text)
    return (len(quoted) if quoted.isascii() else len(quoted.encode())) - 2


def _without_surrogates(text: str) -> str:
    return text.encode("utf-8", "replace").decode()
