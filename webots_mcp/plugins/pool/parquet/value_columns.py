"""The chunks of a run as columns of Parquet, a row for each state, and chunks again.

Each signal has a column of its name, of one type: double, boolean or string. What else it held in
a row (null, a text among numbers, what JSON cannot hold) stands in the column `others`, as JSON by
the name of the column: an array says what was replaced, as in `chunk.labels`. A signal that is
called as one of the columns that every file has has its id behind its name.
"""

from __future__ import annotations

import io
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from webots_mcp.plugins.pool.parquet.arrow_rows import clear_damage
from webots_mcp.plugins.pool.parquet.packages import package
from webots_mcp.plugins.pool.row_batch import Row
from webots_mcp.plugins.pool.shipped_tables import table
from webots_mcp.store.analysis.arrays import np
from webots_mcp.store.chunks.codec import (
    ABSENT,
    IS_NUMBER,
    DamagedChunkError,
    Decoded,
    Encoded,
    Recorded,
    Replaced,
    decode,
    decoded_of,
    encode,
)
from webots_mcp.store.chunks.statistics import statistics_of
from webots_mcp.store.chunks.stored import SIM_TIMES, STATE_IDS, WALL_TIMES

_PLACES: Final = {"state_id": STATE_IDS, "sim_time_s": SIM_TIMES, "wall_time_s": WALL_TIMES}
_FIXED: Final = frozenset({"group_id", "others", *_PLACES, "recording", "recording_uuid", "run",
                           "run_id", "table"})  # fmt: skip
_FIRST_LABEL: Final = 2
_EXACT: Final = 2.0**53
_TIMES: Final = frozenset(_PLACES.values())
_KINDS: Final = {"bool": "bool", "text": "string"}  # the others are doubles
_HOLDS: Final[Mapping[str, type]] = {"bool": bool, "string": str}


class Named(NamedTuple):
    """A signal as the pool has it."""

    name: str
    kind: str


def columns_of(
    chunks: Iterable[Row],
    signals: Mapping[int, Named],
    altered: Counter[str],
    held: Any | None = None,
) -> Any:
    """The chunks of one run as an Arrow table, group after group.

    Args:
        chunks: Rows of the table `chunk`: of each group all.
        signals: By their ids.
        altered: Counts chunks that cannot be read, whose values are left out.
        held: Columns that these are to be put behind, so that they have their types.
    """
    names, arrow = table("chunk").columns, package("pyarrow")
    groups: dict[int, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in chunks:
        chunk = dict(zip(names, row, strict=True))
        groups[chunk["group_id"]][chunk["signal_id"]] = chunk
    found = {_signal_of(field): field.type for field in held.schema} if held is not None else {}
    types = {each: found.get(each) or _type_of(signal) for each, signal in signals.items()}
    made: list[Any] = [] if held is None else [held]
    for group_id, of_group in groups.items():
        values = _decoded(of_group, altered)
        if values.keys() >= _TIMES:  # else nobody knows of when the others are
            made.append(_group(group_id, values, signals, types))
    return arrow.concat_tables(made, promote_options="default") if made else None


def _decoded(chunks: Mapping[int, Mapping[str, Any]], altered: Counter[str]) -> dict[int, Decoded]:
    """The values of the signals of a group, without those that cannot be read."""
    rows = int(chunks[SIM_TIMES]["row_count"]) if SIM_TIMES in chunks else 0
    found: dict[int, Decoded] = {}
    for signal_id, chunk in chunks.items():
        try:
            found[signal_id] = decode(Encoded(*(chunk[name] for name in Encoded._fields)), rows)
        except DamagedChunkError:
            altered["chunk.numbers"] += 1
    return found


def read_columns(content: bytes, path: str) -> Any:
    """The columns of a file.

    Raises:
        PoolError: The file is none, or is damaged.
    """
    with clear_damage(path):
        return package("pyarrow.parquet").read_table(package("pyarrow").BufferReader(content))


def _group(
    group_id: int,
    decoded: dict[int, Decoded],
    signals: Mapping[int, Named],
    types: Mapping[int, Any],
) -> Any:
    arrow = package("pyarrow")
    rows = len(decoded[SIM_TIMES].numbers)
    fields = [arrow.field("group_id", arrow.int64())]
    arrays = [arrow.array(np.full(rows, group_id, np.int64))]
    for name, signal_id in _PLACES.items():
        numbers = decoded.pop(signal_id).numbers
        fields.append(arrow.field(name, arrow.int64() if name == "state_id" else arrow.float64()))
        arrays.append(arrow.array(numbers).cast(fields[-1].type))
    others: dict[int, dict[str, Any]] = defaultdict(dict)
    for signal_id, values in decoded.items():
        if signal_id not in signals:  # another program deleted it
            continue
        name = signals[signal_id].name
        name = f"{name} ({signal_id})" if name.lower() in _FIXED else name
        metadata = {"signal_id": str(signal_id)}
        fields.append(arrow.field(name, types[signal_id], metadata=metadata))
        arrays.append(_array(values, name, fields[-1].type, others))
    texts = [json.dumps(others[row]) if row in others else None for row in range(rows)]
    fields.append(arrow.field("others", arrow.string()))
    arrays.append(arrow.array(texts, arrow.string()))
    return arrow.table(arrays, schema=arrow.schema(fields))


def _type_of(signal: Named) -> Any:
    arrow = package("pyarrow")
    return arrow.type_for_alias(_KINDS.get(signal.kind, "double"))


def _array(values: Decoded, name: str, kind: Any, others: dict[int, dict[str, Any]]) -> Any:
    """A column; what it cannot hold goes to the others."""
    arrow = package("pyarrow")
    holds = _HOLDS.get(str(kind))
    codes = np.zeros(len(values.numbers), np.intp) if values.codes is None else values.codes
    for code, label in enumerate(values.labels, _FIRST_LABEL):
        if holds is None or not isinstance(label, holds):
            told = [label.why] if isinstance(label, Replaced) else label
            for row in np.flatnonzero(codes == code).tolist():
                others[row][name] = told
    if holds is None:
        return arrow.array(values.numbers, mask=codes != IS_NUMBER)
    for row in np.flatnonzero(codes == IS_NUMBER).tolist():
        others[row][name] = values.numbers[row]
    fitting = [each if isinstance(each, holds) else None for each in values.labels]
    by_code = [None, None, *fitting]
    return arrow.array([by_code[code] for code in codes.tolist()], kind)


def chunks_of(held: Any, run_id: int) -> Iterator[Row]:
    """The rows of the table `chunk` that columns were made of; their ids are given anew."""
    compute = package("pyarrow.compute")
    for group_id in compute.unique(held.column("group_id")).to_pylist():
        group = held.filter(compute.equal(held.column("group_id"), group_id))
        others: list[dict[str, Any]] = [
            json.loads(text) if text else {} for text in group.column("others").to_pylist()
        ]
        for field in group.schema:
            signal_id = _signal_of(field)
            if signal_id is not None:
                values = _recorded(group.column(field.name), field.name, others)
                if any(value is not ABSENT for value in values):
                    yield _chunk(group_id, run_id, signal_id, values)


def _signal_of(field: Any) -> int | None:
    if field.name in _PLACES:
        return _PLACES[field.name]
    told = (field.metadata or {}).get(b"signal_id")
    return None if told is None else int(told)


def _recorded(column: Any, name: str, others: Sequence[Mapping[str, Any]]) -> list[Recorded]:
    """The values of a signal; whole numbers as such, which are smaller."""
    values: list[Any] = column.to_pylist()
    if str(column.type) == "double" and all(map(_is_whole, values)):
        values = [None if value is None else int(value) for value in values]
    return [
        _other(other[name]) if name in other else ABSENT if value is None else value
        for value, other in zip(values, others, strict=True)
    ]


def _is_whole(value: float | None) -> bool:
    if value is None:
        return True
    return value.is_integer() and abs(value) < _EXACT and (value != 0 or str(value) == "0.0")


def _other(value: Any) -> Recorded:
    return Replaced(value[0]) if isinstance(value, list) else value


def _chunk(group_id: int, run_id: int, signal_id: int, values: Sequence[Recorded]) -> Row:
    figures = statistics_of(decoded_of(values))
    named = {"group_id": group_id, "run_id": run_id, "signal_id": signal_id}
    named |= figures._asdict() | encode(values)._asdict()
    return tuple(named.get(column) for column in table("chunk").columns)


def encoded_columns(held: Any) -> bytes:
    """As one file of Parquet."""
    sink = io.BytesIO()
    package("pyarrow.parquet").write_table(held, sink, compression="zstd")
    return sink.getvalue()
