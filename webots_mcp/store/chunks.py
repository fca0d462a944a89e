"""Encode the values of one signal over some rows as bytes, and decode them again.

Numbers are compressed by pcodec without loss. Each row has a code: it holds a number, its state
does not have the signal, or it holds one of a few other values (a text, a flag, null), which are
stored as JSON in a list of labels. If every row holds a number, there are no codes.
"""

from __future__ import annotations

import atexit
import functools
import json
import math
import shutil
import sqlite3
import tempfile
import zlib
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.analysis.arrays import Array, Indexes, inner, np
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import DatabaseError, MalformedRowError
from webots_mcp.signals.naming import (
    INDEXES,
    LONGEST_SPREAD_ARRAY,
    REDUCTIONS,
    Value,
    flatten,
    reduce_array,
)

MAX_TEXT: Final = 200  # characters of a text value that are stored and compared
ANY_ITEM: Final = "*"
IS_NUMBER: Final = 0  # codes
IS_ABSENT: Final = 1
FIRST_LABEL: Final = 2  # codes from this one on are indexes of labels

EXACT_INTEGERS: Final = 2**53  # beyond it, a float does not hold every integer
_FLOATS, _INTEGERS = "pcodec/float64", "pcodec/int64"
_NUMBERS: Final = frozenset({int, float})
LARGEST: Final = 1e100  # beyond it (a stray infinity, a huge integer) squares would overflow
STATE_COLUMNS: Final = "id, sim_time_s, wall_time_s, data, replaced"
SIM_TIMES: Final = 0  # in the place of a signal's id
WALL_TIMES: Final = -1
STATE_IDS: Final = -2
NEWEST_STATE_ID: Final = (  # the highest id ever assigned
    "max((SELECT coalesce(max(id), 0) FROM state), (SELECT coalesce(max(CAST(reserved_state_id "
    "AS INTEGER)), 0) FROM recording))"
)
IS_MARK: Final = (  # no value of another program, beyond which no row would be examined
    f"typeof(state_id) = 'integer' AND state_id >= 0 AND state_id <= {NEWEST_STATE_ID}"
)
_OF_SIGNAL: Final = "FROM chunk WHERE run_id = ? AND signal_id = ? AND group_id BETWEEN ? AND ?"
_FEW: Final = 0.25  # maximum number of groups between two of them: they are queried one by one
_SEEN: Final = ("signal", "row_group", "chunk", "watermark")
_COPIED: Final = ("robot", "session", "run", *_SEEN)
_UUID: Final = "SELECT uuid FROM {}.recording"  # a new file may reuse the inode of a deleted one


@dataclass(frozen=True)
class ChunkCompression:
    """How chunks are compressed.

    Attributes:
        numbers_level: Level of pcodec: a quarter of the time of its default, for 2 % more bytes.
        codes_level: Level of zlib for codes.
        checksum_bytes: Size of a CRC-32, so that no decompressor is given damaged bytes.
    """

    numbers_level: int = 4
    codes_level: int = 1
    checksum_bytes: int = 4


_COMPRESSION: Final = ChunkCompression()
_DECODER: Final = json.JSONDecoder()


class Absent:
    """Stands for a signal that a row's state does not have."""


class Replaced(NamedTuple):
    """Stands for a value that JSON cannot hold, with the reason, such as nan or inf."""

    why: str


ABSENT: Final = Absent()
Recorded: TypeAlias = "Value | Absent | Replaced"


class DamagedChunkError(DatabaseError):
    """A chunk cannot be read; the text says why."""


class UnsupportedChunkError(DamagedChunkError):
    """A chunk is intact, but this installation cannot read it."""


class EncodedChunk(NamedTuple):
    """The values of a signal as a row of the table `chunk` holds them.

    Attributes:
        codec: Compression of `numbers`.
        numbers: The numbers of the rows that hold one.
        codes: One per row, compressed by zlib; None if every row holds a number.
        labels: JSON array with the meaning of codes from 2 on.
    """

    codec: str
    numbers: bytes | None
    codes: bytes | None
    labels: str | None


class Decoded(NamedTuple):
    """The values of a signal over some rows.

    Attributes:
        numbers: One per row: NaN if it holds none; flags are 0 and 1.
        codes: One per row; None if every row holds a number.
        labels: The meaning of codes from 2 on; `Replaced` for a replaced value.
        is_whole: Whether all numbers were integers when they were stored.
    """

    numbers: Array
    codes: Indexes | None
    labels: Sequence[Value | Replaced]
    is_whole: bool = False


def decoded_of(values: Sequence[Recorded]) -> Decoded:
    """Return values that were not stored in the form of decoded ones, without compressing them."""
    types = set(map(type, values))
    if _NUMBERS.issuperset(types):
        held = _numbers(values)
        return Decoded(held, None, (), types == {int} and _is_exact(held))
    codes, labels = _coded(values)
    numbers = np.full(len(values), np.nan)
    held = _numbers([value for value in values if type(value) in _NUMBERS])
    numbers[codes == IS_NUMBER] = held
    _fill_flags(numbers, codes, labels)
    return Decoded(numbers, codes, labels, float not in types and _is_exact(held))


def encode(values: Sequence[Recorded]) -> EncodedChunk:
    """Compress the values of some rows; see `pack`.

    Integers beyond 2^53 become floats, texts are cut after 200 characters, and a mix of integers
    and floats becomes floats.
    """
    return pack(decoded_of(values))


def pack(values: Decoded) -> EncodedChunk:
    """Compress values that already are numbers and codes."""
    if values.codes is None:
        return EncodedChunk(*_compressed(values.numbers, values.is_whole), None, None)
    listed = [[label.why] if isinstance(label, Replaced) else label for label in values.labels]
    width = np.uint8 if len(listed) + FIRST_LABEL < 2**8 else np.uint16
    return EncodedChunk(
        *_compressed(values.numbers[values.codes == IS_NUMBER], values.is_whole),
        zlib.compress(values.codes.astype(width).tobytes(), _COMPRESSION.codes_level),
        json.dumps(listed, separators=(",", ":"), ensure_ascii=False),
    )


def decode(encoded: EncodedChunk, rows: int, into: Array | None = None) -> Decoded:
    """Return the values of some rows.

    Args:
        encoded: The chunk.
        rows: The number of rows.
        into: Receives their numbers if every row holds one; None for a new array.

    Raises:
        DamagedChunkError: The bytes are not what `encode` produces for that number of rows.
    """
    try:
        if encoded.codes is None:
            numbers: Array = np.empty(rows) if into is None else into
            _decompress(encoded, numbers)
            return Decoded(numbers, None, (), encoded.codec == _INTEGERS)
        return _decode_coded(encoded, rows)
    except ModuleNotFoundError as error:
        how_to_install = "install it: pip install --only-binary pcodec 'pcodec>=1.0'"
        raise UnsupportedChunkError(
            f"chunks need {error.name}, which is missing: {how_to_install}"
        ) from None
    except DamagedChunkError:
        raise
    except Exception as error:  # the library may raise anything for bytes that it did not produce
        raise DamagedChunkError(f"damaged: {error}") from error


def is_damaged(encoded: EncodedChunk, rows: int) -> bool:
    """Return whether the bytes of a chunk are not what `encode` makes of that number of rows."""
    try:
        decode(encoded, rows)
    except UnsupportedChunkError:
        return False
    except DamagedChunkError:
        return True
    return False


def _decode_coded(encoded: EncodedChunk, rows: int) -> Decoded:
    assert encoded.codes is not None
    raw = zlib.decompress(encoded.codes)
    width: Any = np.uint8 if len(raw) == rows else np.uint16
    short = np.frombuffer(raw, width)
    labels = _labels(encoded.labels)
    if len(short) != rows or short.max(initial=0) >= len(labels) + FIRST_LABEL:
        raise DamagedChunkError("damaged: its codes are not those of its rows")
    flags = [each if isinstance(each, bool) else math.nan for each in labels]
    of_codes: Array = np.array([math.nan, math.nan, *flags], np.float64)
    codes: Indexes = short.astype(np.intp)
    numbers: Array = of_codes[codes]
    held = short == IS_NUMBER
    if held.any():
        found = np.empty(int(np.count_nonzero(held)))
        _decompress(encoded, found)
        numbers[held] = found
    return Decoded(numbers, codes, labels, encoded.codec == _INTEGERS)


def _labels(text: str | None) -> list[Value | Replaced]:
    listed: Any = json.loads(text or "[]")
    if not isinstance(listed, list):
        raise DamagedChunkError("damaged: its labels are no list")
    return [_label(each) for each in cast("list[Any]", listed)]


def _label(label: Any) -> Value | Replaced:
    if label is None or isinstance(label, str | bool):
        return label
    match label:
        case [str(why)]:
            return Replaced(why)
        case _:
            raise DamagedChunkError("damaged: its labels are not those of values")


def _fill_flags(numbers: Array, codes: Indexes, labels: Sequence[Value | Replaced]) -> None:
    for code, label in enumerate(labels, FIRST_LABEL):
        if isinstance(label, bool):
            numbers[codes == code] = label


def _coded(values: Sequence[Recorded]) -> tuple[Indexes, list[Value | Replaced]]:
    """Return the code of each row, and the labels."""
    labels: list[Value | Replaced] = []
    known: dict[object, int] = {}  # a flag equals a number, so the key contains the type
    codes = np.empty(len(values), np.intp)
    for row, value in enumerate(values):
        if type(value) in _NUMBERS:
            codes[row] = IS_NUMBER
        elif isinstance(value, Absent):
            codes[row] = IS_ABSENT
        else:
            code = known.get(value)
            if code is None:
                label = value[:MAX_TEXT] if isinstance(value, str) else value
                code = known[value] = len(labels) + FIRST_LABEL
                labels.append(label)  # pyright: ignore[reportArgumentType]
            codes[row] = code
    return codes, labels


def _numbers(values: Sequence[Any]) -> Array:
    """Convert to floats; an integer that is too large becomes infinite."""
    try:
        return np.array(values, np.float64)
    except OverflowError:
        return np.array([_float(value) for value in values], np.float64)


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


@functools.cache
def _pcodec(module: str = "pcodec.standalone") -> Any:
    """Return the untyped library, imported when the first chunk is made or read."""
    return import_module(module)


def _is_exact(numbers: Array) -> bool:
    """Return whether floats hold these integers exactly."""
    return bool(np.abs(numbers).max(initial=0) < EXACT_INTEGERS)


def _compressed(numbers: Any, is_whole: bool) -> tuple[str, bytes | None]:
    if not len(numbers):
        # No row holds a number.
        return "none", None
    codec = _INTEGERS if is_whole else _FLOATS
    config = _pcodec("pcodec").ChunkConfig(compression_level=_COMPRESSION.numbers_level)
    numbers = numbers.astype(np.int64) if is_whole else numbers
    packed = bytes(_pcodec().simple_compress(numbers, config))
    return codec, zlib.crc32(packed).to_bytes(_COMPRESSION.checksum_bytes, "little") + packed


def _decompress(encoded: EncodedChunk, into: Array) -> None:
    if encoded.codec not in (_FLOATS, _INTEGERS):
        raise UnsupportedChunkError(
            f"compressed by {encoded.codec!r}, which this version of webots-mcp does not know"
        )
    if encoded.numbers is None:
        raise DamagedChunkError("damaged: its numbers are missing")
    packed = encoded.numbers[_COMPRESSION.checksum_bytes :]
    if zlib.crc32(packed) != int.from_bytes(
        encoded.numbers[: _COMPRESSION.checksum_bytes], "little"
    ):
        raise DamagedChunkError("damaged: its bytes do not match their checksum")
    whole: Any = into if encoded.codec == _FLOATS else np.empty(len(into), np.int64)
    progress = _pcodec().simple_decompress_into(packed, whole)
    if progress.n_processed != len(into) or not progress.finished:
        raise DamagedChunkError("damaged: it holds fewer numbers than its rows")
    if whole is not into:
        into[:] = whole


# Statistics of the numbers of one signal in one chunk, so that a reader need not open it.


class Statistics(NamedTuple):
    """Statistics of a chunk, as columns of the table `chunk`; None without numbers, as for texts.

    Attributes:
        row_count: Number of rows whose state has the signal.
        value_count: Number of rows with a value that is not null; for numbers, a usable value: not
            NaN and not beyond 1e100.
        change_count: Number of values that differ from the one before.
        squared_deviations: Sum of squared deviations from the mean.
        largest_step: Largest difference between consecutive values; 0 for a single one.
    """

    row_count: int
    value_count: int
    change_count: int = 0
    first: float | None = None
    last: float | None = None
    min: float | None = None
    max: float | None = None
    sum: float | None = None
    squared_deviations: float | None = None
    largest_step: float | None = None


def statistics_of(values: Decoded) -> Statistics:
    """Return the statistics of the values of one signal in some rows."""
    rows = len(values.numbers)
    if values.codes is not None:
        rows -= int(np.count_nonzero(values.codes == IS_ABSENT))
    usable = np.abs(values.numbers) <= LARGEST
    numbers = values.numbers if usable.all() else values.numbers[usable]
    if not len(numbers):
        return _without_numbers(values, rows)
    mean = float(numbers.sum()) / len(numbers)
    deviations, steps = numbers - mean, np.diff(numbers)
    return Statistics(
        rows,
        len(numbers),
        int(np.count_nonzero(steps)),
        float(numbers[0]),
        float(numbers[-1]),
        float(numbers.min()),
        float(numbers.max()),
        float(numbers.sum()),
        inner(deviations, deviations),
        float(np.abs(steps).max(initial=0.0)),
    )


def _without_numbers(values: Decoded, rows: int) -> Statistics:
    """Return the statistics of texts: their number and how often they change."""
    if values.codes is None:
        return Statistics(rows, 0)
    texts = [
        code for code, label in enumerate(values.labels, FIRST_LABEL) if isinstance(label, str)
    ]
    codes = values.codes[np.isin(values.codes, texts)]
    return Statistics(rows, len(codes), int(np.count_nonzero(np.diff(codes))))


# State rows as columns: one value per row and signal.


@dataclass
class StateColumns:
    """Rows of one run in order.

    Attributes:
        values: One value per row and signal: `ABSENT` if the state does not have the signal,
            `Replaced` if it held what JSON cannot hold.
        texts: The states as recorded, in JSON.
    """

    ids: list[int] = field(default_factory=list[int])
    times: list[float] = field(default_factory=list[float])
    wall_times: list[float] = field(default_factory=list[float])
    texts: list[str] = field(default_factory=list[str])
    values: dict[str, list[Recorded]] = field(default_factory=dict[str, "list[Recorded]"])

    def __len__(self) -> int:
        return len(self.ids)

    def add(self, rows: Sequence[tuple[Any, ...]], whose: str = "") -> None:
        """Add rows of `STATE_COLUMNS`. A row whose data is no JSON object has no signals.

        Raises:
            MalformedRowError: Another program wrote a value that no bridge writes.
        """
        if not rows:
            return
        before = len(self.ids)
        ids, times, walls, texts, replaced = zip(*rows, strict=True)
        if not _NUMBERS.issuperset(map(type, times + walls)) or {*map(type, texts)} != {str}:
            number = next(
                number for number, *moments, text, _ in rows
                if type(text) is not str or not _NUMBERS.issuperset(map(type, moments))
            )  # fmt: skip
            raise MalformedRowError(
                f"{whose}row {abs(number)} of table {'kept_' * (number < 0)}state has a time that "
                "is no number, or data that is no text"
            )
        self.ids += ids
        self.times += times
        self.wall_times += walls
        self.texts += texts
        columns = _columns_of([parse(text) for text in texts])
        for name in [name for name in columns if name not in self.values]:
            self.values[name] = [ABSENT] * before
        for name, values in self.values.items():
            values += columns.get(name) or [ABSENT] * len(rows)
        for row, why in enumerate(replaced, before):
            if why is not None:
                self._note_replaced(row, why)

    def _note_replaced(self, row: int, text: str) -> None:
        reasons = replaced_names(text)
        for name in reasons.keys() & self.values.keys():
            values = self.values[name]
            value: Any = values[row]
            if value is not ABSENT and is_replaced(reasons, name, value) and value is None:
                values[row] = Replaced(reasons[name])

    def part(self, start: int, rows: int) -> StateColumns:
        """Return a slice of the rows."""
        inside = slice(start, start + rows)
        values = {name: values[inside] for name, values in self.values.items()}
        places = (self.ids[inside], self.times[inside], self.wall_times[inside])
        return StateColumns(*places, self.texts[inside], values)


def _columns_of(states: Sequence[dict[str, Any]]) -> dict[str, list[Recorded]]:
    """Return the value of each name in each state, as `flatten` names and reduces them."""
    columns: dict[str, list[Recorded]] = {}
    if _spread_alike("", _items_of(states), columns):
        return columns
    flat = [flatten(state) for state in states]
    every = dict.fromkeys(name for state in flat for name in state)
    return {name: [state.get(name, ABSENT) for state in flat] for name in every}


_Items = Iterable[tuple[str, tuple[Any, ...]]]


def _spread_alike(prefix: str, items: _Items | None, columns: dict[str, list[Recorded]]) -> bool:
    """Spread many states at once, each name in one go; return whether all have the same form.

    Most states of a run have the same names in one order, and arrays of the same lengths.
    """
    if items is None:
        return False
    for key, values in items:
        kinds = set(map(type, values))
        if not kinds & {dict, list}:
            columns[prefix + key] = list(values)
        elif len(kinds) > 1:
            return False
        elif kinds == {dict}:
            if not _spread_alike(f"{prefix}{key}.", _items_of(values), columns):
                return False
        elif len(set(map(len, values))) > 1:
            return False
        elif len(values[0]) <= LONGEST_SPREAD_ARRAY:
            spread = zip(INDEXES, zip(*values, strict=True), strict=False)
            if not _spread_alike(f"{prefix}{key}.", spread, columns):
                return False
        else:
            reduced = zip(*map(reduce_array, values), strict=True)
            for reduction, column in zip(REDUCTIONS, reduced, strict=True):
                columns[f"{prefix}{key}.{reduction}"] = list(column)
    return True


def _items_of(states: Sequence[dict[str, Any]]) -> _Items | None:
    """Return each key with its values in all states; None if their keys or order differ."""
    keys = list(states[0])
    if any(list(state) != keys for state in states):
        return None
    return zip(keys, zip(*(state.values() for state in states), strict=True), strict=False)


# The stored chunks of a run: its groups of rows and their content.


class ChunkGroup(NamedTuple):
    """Consecutive rows of which each signal has a chunk. Columns of `row_group`."""

    id: int
    start_s: float
    end_s: float
    last_state_id: int
    max_state_id: int
    row_count: int


class ChunkProgress(NamedTuple):
    """Which rows of a run are in chunks: those up to a place, except rows that arrived later.

    Attributes:
        end_s: Simulation time of the last of them; -inf before the first chunk.
        last_state_id: Its id; rows with the same time are ordered by id.
        max_state_id: Rows up to that place with greater ids arrived late and are in no chunk.
        max_in_groups: The highest id of a row that is in a chunk.
    """

    end_s: float
    last_state_id: int
    max_state_id: int
    max_in_groups: int


def groups_in(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> list[ChunkGroup]:
    """Return the groups of a run that overlap [start_s, end_s), ordered by time."""
    rows = connection.execute(
        "SELECT id, start_sim_time_s, end_sim_time_s, last_state_id, max_state_id, row_count "
        "FROM row_group WHERE run_id = ? AND is_complete = 1 AND start_sim_time_s < ? "
        "AND end_sim_time_s >= ? ORDER BY start_sim_time_s, end_sim_time_s, id",
        (run_id, end_s, start_s),
    ).fetchall()
    return list(map(ChunkGroup._make, rows))


def groups_as_array(
    connection: sqlite3.Connection, run_id: int, start_s: float, end_s: float
) -> Array:
    """Return the groups as columns: id, times of first and last row in s, row count, highest id."""
    rows = connection.execute(
        "SELECT id, start_sim_time_s, end_sim_time_s, row_count, max_state_id FROM row_group "
        "WHERE run_id = ? AND is_complete = 1 AND start_sim_time_s < ? AND end_sim_time_s >= ? "
        "ORDER BY start_sim_time_s",
        (run_id, end_s, start_s),
    ).fetchall()
    table: Array = np.reshape(np.array(rows, np.float64), (-1, 5))
    return table[np.lexsort((table[:, 0], table[:, 2], table[:, 1]))]


def reached(connection: sqlite3.Connection, run_id: int) -> ChunkProgress:
    """Return up to where the rows of a run are in chunks."""
    end_s, max_id = connection.execute(
        "SELECT max(end_sim_time_s), max(max_state_id) FROM row_group WHERE run_id = :run "
        "AND is_complete = 1",
        {"run": run_id},
    ).fetchone()
    if end_s is None:
        return ChunkProgress(float("-inf"), 0, 0, 0)
    (last_id,) = connection.execute(
        "SELECT max(last_state_id) FROM row_group WHERE run_id = ? AND is_complete = 1 "
        "AND end_sim_time_s = ?",
        (run_id, end_s),
    ).fetchone()
    return ChunkProgress(end_s, last_id, max(max_id, watermark(connection)), max_id)


def watermark(connection: sqlite3.Connection) -> int:
    """Return the id up to which the rows of all runs were examined, so that none arrives late."""
    row = connection.execute(
        f"SELECT state_id FROM watermark WHERE name = 'chunk' AND {IS_MARK}"
    ).fetchone()
    return int(row[0]) if row else 0


def signals_in(connection: sqlite3.Connection, run_id: int) -> set[int]:
    """Return the ids of the signals that have chunks in a run."""
    return {
        signal_id
        for (signal_id,) in connection.execute(
            "SELECT DISTINCT signal_id FROM chunk WHERE run_id = ? AND signal_id > 0", (run_id,)
        )
    }


def statistics_in(
    connection: sqlite3.Connection, run_id: int, signal_id: int, between: tuple[int, int]
) -> Array:
    """Return the statistics of a signal in the groups between two ids, a row per group that has it.

    The first column is the id of the group, the others are the fields of `Statistics`.
    """
    rows = connection.execute(
        f"SELECT group_id, {', '.join(Statistics._fields)} {_OF_SIGNAL}",
        (run_id, signal_id, *between),
    ).fetchall()
    return np.reshape(np.array(rows, np.float64), (-1, 1 + len(Statistics._fields)))


def statistics_by_signal(
    connection: sqlite3.Connection, run_id: int, group_id: int
) -> dict[int, Statistics]:
    """Return the statistics of each signal in one group of a run, by the signal's id."""
    rows = connection.execute(
        f"SELECT signal_id, {', '.join(Statistics._fields)} FROM chunk WHERE run_id = ? "
        "AND signal_id > 0 AND group_id = ?",
        (run_id, group_id),
    ).fetchall()
    return {signal_id: Statistics(*figures) for signal_id, *figures in rows}


def chunks_by_signal(
    connection: sqlite3.Connection, run_id: int, group_id: int
) -> dict[int, EncodedChunk]:
    """Return the chunks of all signals, times and ids in one group of a run, by their ids."""
    rows = connection.execute(
        "SELECT signal_id, codec, numbers, codes, labels FROM chunk "
        "WHERE +run_id = ? AND group_id = ?",
        (run_id, group_id),
    ).fetchall()
    return {signal_id: EncodedChunk(*stored) for signal_id, *stored in rows}


def decoded_or_why(
    encoded: EncodedChunk, rows: int, into: Array | None
) -> Decoded | DamagedChunkError:
    """Decode a chunk like `decode`; return the error instead if it cannot be read."""
    try:
        return decode(encoded, rows, into)
    except DamagedChunkError as error:
        return error


def values_in(
    connection: sqlite3.Connection,
    run_id: int,
    signal_id: int,
    wanted: Mapping[int, int],
    into: Mapping[int, Array] | None = None,
) -> Iterator[tuple[int, Decoded | DamagedChunkError]]:
    """Yield the values of a signal in some groups, by group id and in no order.

    Groups without the signal are left out. For a chunk that cannot be read, the error is yielded.

    Args:
        connection: An open database.
        run_id: The run.
        signal_id: The signal, or the number that stands for times or ids.
        wanted: The number of rows of each group, by its id.
        into: Arrays that receive the numbers of some groups; see `decode`.
    """
    into = into or {}
    for group_id, *stored in connection.execute(*_chunks_of(run_id, signal_id, wanted)):
        rows = wanted.get(group_id)
        if rows is None:
            continue
        yield group_id, decoded_or_why(EncodedChunk(*stored), rows, into.get(group_id))


def fill_numbers(
    connection: sqlite3.Connection, run_id: int, signal_id: int, into: Mapping[int, Array]
) -> list[int]:
    """Decode chunks of a signal right into arrays, as long as each of their rows holds a number.

    It ends at the first chunk that is another or cannot be read, since whole columns are mostly of
    one sort: `values_in` reads the other groups.

    Args:
        connection: Any.
        run_id: Of which run.
        signal_id: Of which signal; or times or ids.
        into: An array of as many rows as the group has, by its id.

    Returns:
        The groups whose numbers are in their array.
    """
    filled: list[int] = []
    stored = connection.execute(*_chunks_of(run_id, signal_id, into))
    for group_id, *encoded in stored:
        target = into.get(group_id)
        if target is None:
            continue
        chunk = EncodedChunk(*encoded)
        if chunk.codes is not None or isinstance(
            decoded_or_why(chunk, len(target), target), DamagedChunkError
        ):
            break
        filled.append(group_id)
    stored.close()
    return filled


def _chunks_of(run_id: int, signal_id: int, wanted: Collection[int]) -> tuple[str, list[Any]]:
    """The query for the chunks of a signal in some groups, and perhaps in others between them."""
    query = f"SELECT group_id, codec, numbers, codes, labels {_OF_SIGNAL}"
    first, last = min(wanted, default=0), max(wanted, default=-1)
    if len(wanted) >= _FEW * (last - first):
        return query, [run_id, signal_id, first, last]
    query += " AND group_id IN (SELECT value FROM json_each(?))"
    return query, [run_id, signal_id, first, last, json.dumps([*wanted])]


# Chunks of a recording that must not be written are made once, in a temporary file of this process.
# The file is a recording without states, which are read from the other one. A reader sees its
# groups, chunks and signals in place of those of the recording. It is deleted when the process
# ends.


class _Made(NamedTuple):
    file: Path
    uuid: str  # of the recording
    last_id: int  # id up to which its rows are in chunks


_made: dict[tuple[int, int], _Made] = {}


def is_chunked_aside(connection: sqlite3.Connection, database: Path) -> bool:
    """Return whether this process has chunks of a recording beyond those that the recording has.

    A server that has started to maintain it in the meantime deletes rows after putting them into
    chunks.
    """
    try:
        made = _made.get(_key(database))
    except FileNotFoundError:  # moved since the connection was opened
        return False
    if made is None or connection.execute(_UUID.format("main")).fetchone() != (made.uuid,):
        return False
    (mark,) = connection.execute(
        f"SELECT state_id FROM main.watermark WHERE name = 'chunk' AND {IS_MARK}"
    ).fetchone() or (0,)
    return mark < made.last_id


def show_chunks_aside(connection: sqlite3.Connection, database: Path) -> None:
    """Make the chunks that this process holds for its recording visible to a reader."""
    if not is_chunked_aside(connection, database):
        return
    file = _made[_key(database)].file
    connection.execute("ATTACH DATABASE ? AS aside", (f"{file.as_uri()}?mode=ro",))
    connection.execute("PRAGMA query_only=OFF")  # for views of this connection alone
    for table in _SEEN:
        connection.execute(f"CREATE TEMP VIEW {table} AS SELECT * FROM aside.{table}")
    connection.execute("PRAGMA query_only=ON")


@contextmanager
def chunks_aside(database: Path, *, frozen: bool) -> Generator[sqlite3.Connection]:
    """Open a connection on which `make_chunks` writes into the temporary file for readers.

    Args:
        database: The recording.
        frozen: Whether no process writes to it or can write to it.
    """
    key = _key(database)
    file = _made[key].file if key in _made else _new_file()
    with closing(sqlite3.connect(file, isolation_level=None)) as connection:
        immutable = "&immutable=1" if frozen else ""
        address = f"{database.absolute().as_uri()}?mode=ro{immutable}"
        connection.execute("ATTACH DATABASE ? AS recorded", (address,))
        (uuid,) = connection.execute(_UUID.format("recorded")).fetchone()
        if key not in _made or _made[key].uuid != uuid:
            for table in _COPIED:
                connection.execute(f"DELETE FROM main.{table}")
                connection.execute(f"INSERT INTO main.{table} SELECT * FROM recorded.{table}")
        try:
            yield connection
        finally:
            (last_id,) = connection.execute(
                "SELECT coalesce(max(max_state_id), 0) FROM row_group WHERE is_complete = 1"
            ).fetchone()  # also left over by interrupted work
            _made[key] = _Made(file, uuid, max(last_id, watermark(connection)))


def _new_file() -> Path:
    """Create the file; what is not copied into it is read from the recording."""
    folder = tempfile.mkdtemp(prefix="webots-mcp-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    file = Path(folder) / DATABASE_NAME
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        connection.execute("PRAGMA foreign_keys=OFF")
        connection.execute("PRAGMA journal_mode=DELETE")
        for kind, name in connection.execute(
            "SELECT type, name FROM main.sqlite_master WHERE type = 'view' OR type = 'table' "
            f"AND name NOT IN {_COPIED} AND name NOT LIKE 'sqlite_%'"
        ).fetchall():
            connection.execute(f"DROP {kind} {name}")
    return file


def _key(database: Path) -> tuple[int, int]:
    status = database.stat()
    return status.st_dev, status.st_ino


def parse(text: str) -> dict[str, Any]:
    """Parse the JSON text of a state row; return {} if it is no JSON object (a foreign row)."""
    try:
        if text[:1] == "{":  # the usual form takes half the time of `json.loads`
            state, end = _DECODER.raw_decode(text)
            if end == len(text):
                return state
        state = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return cast("dict[str, Any]", state) if isinstance(state, dict) else {}


def shown(value: Value) -> str | None:
    """Return a value of a text or boolean signal in the form that change points use."""
    if value is None or isinstance(value, str):
        return value[:MAX_TEXT] if value else value
    return json.dumps(value)


def replaced_names(replaced: str | None) -> dict[str, str]:
    """Return what was replaced (nan, inf, ...) by signal: by its own name or an item of its array.

    An array whose nulls are all of one kind is listed for every item and under `name.*`.
    """
    if replaced is None:
        return {}
    reasons: dict[str, str] = {}
    for path, reason in cast("dict[str, str]", parse(replaced)).items():
        array, _, item = path.rpartition(".")
        if item == ANY_ITEM:
            reasons.update((f"{array}.{index}", reason) for index in range(LONGEST_SPREAD_ARRAY))
        if item == ANY_ITEM or item.isdecimal():
            reasons.update((f"{array}.{reduction}", reason) for reduction in REDUCTIONS)
        reasons[path] = reason
    return reasons


def is_replaced(reasons: dict[str, str], name: str, value: Value) -> bool:
    """Return whether the reasons of a row concern a value; those of `name.*` concern only nulls."""
    array, _, item = name.rpartition(".")
    return not item.isdecimal() or value is None or f"{array}.{ANY_ITEM}" not in reasons
