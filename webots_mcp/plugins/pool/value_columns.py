"""The chunks of a run as Parquet columns with a row for each state, and the way back.

Each signal has a column with its name and the type of most of its values: double, boolean or
string. Other values of a row (null, a text among numbers, what JSON cannot hold) are in the column
`others`, as a JSON object by the name of the column. An array in it says what was replaced, as in
`chunk.labels`. If a signal has the name of a fixed column, its id is appended to the name.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, TypeAlias

from webots_mcp.analysis.arrays import np
from webots_mcp.plugins.pool.pool_interface import PoolRow, table
from webots_mcp.plugins.pool.storage import package
from webots_mcp.signals.naming import Value
from webots_mcp.store.chunks import (
    FIRST_LABEL,
    IS_ABSENT,
    IS_NUMBER,
    SIM_TIMES,
    STATE_IDS,
    WALL_TIMES,
    DamagedChunkError,
    Decoded,
    EncodedChunk,
    Replaced,
    decode,
    pack,
    statistics_of,
)

_PLACES: Final = {"state_id": STATE_IDS, "sim_time_s": SIM_TIMES, "wall_time_s": WALL_TIMES}
_FIXED: Final = frozenset({"group_id", "others", *_PLACES, "recording", "recording_uuid", "run",
                           "run_id", "table"})  # fmt: skip
_HELD: Final[Mapping[str, type]] = {"bool": bool, "string": str}


NameAndKind: TypeAlias = "tuple[str, str]"


def columns_of(
    chunks: Iterable[PoolRow],
    signals: Mapping[int, NameAndKind],
    altered: Counter[str],
    held: Any | None = None,
) -> Any:
    """Return the chunks of one run as an Arrow table, group after group.

    Args:
        chunks: Rows of the table `chunk`, with all chunks of each group.
        signals: Names and kinds of signals by id.
        altered: Counts chunks that cannot be read.
        held: Table that the rows are appended to, whose types they take.
    """
    arrow = package("pyarrow")
    types = {} if held is None else {_signal_of(field): field.type for field in held.schema}
    groups: dict[int, dict[int, dict[str, Any]]] = defaultdict(dict)
    for row in chunks:
        chunk: dict[str, Any] = dict(zip(table("chunk").columns, row, strict=True))
        groups[chunk["group_id"]][chunk["signal_id"]] = chunk
    made: list[Any] = [
        arrow.table({"group_id": arrow.array([], arrow.int64())}) if held is None else held
    ]
    for group_id, of_group in groups.items():
        values = _decoded(of_group, altered)
        if values.keys() >= set(_PLACES.values()):  # Without times, the others are of no use.
            made.append(_group(group_id, values, signals, types))
    return arrow.concat_tables(made, promote_options="default")


def _decoded(chunks: Mapping[int, Mapping[str, Any]], altered: Counter[str]) -> dict[int, Decoded]:
    """Return the values of a group by signal; unreadable values become replaced ones."""
    rows = int(chunks[SIM_TIMES]["row_count"]) if SIM_TIMES in chunks else 0

    def values_of(chunk: Mapping[str, Any]) -> Decoded | None:
        try:
            return decode(EncodedChunk(*(chunk[name] for name in EncodedChunk._fields)), rows)
        except DamagedChunkError:
            altered["damaged chunk"] += 1
        if chunk["signal_id"] <= SIM_TIMES:
            return None
        codes = np.full(rows, FIRST_LABEL, np.intp)
        return Decoded(np.full(rows, np.nan), codes, [Replaced("damaged")])

    found = {signal_id: values_of(chunk) for signal_id, chunk in chunks.items()}
    return {signal_id: values for signal_id, values in found.items() if values is not None}


def _group(
    group_id: int,
    decoded: dict[int, Decoded],
    signals: Mapping[int, NameAndKind],
    types: dict[int | None, Any],
) -> Any:
    arrow = package("pyarrow")
    rows = len(decoded[SIM_TIMES].numbers)
    fields = [arrow.field("group_id", arrow.int64())]
    arrays = [arrow.array(np.full(rows, group_id, np.int64))]
    for name, signal_id in _PLACES.items():
        fields.append(arrow.field(name, arrow.int64() if name == "state_id" else arrow.float64()))
        arrays.append(arrow.array(decoded.pop(signal_id).numbers).cast(fields[-1].type))
    others: dict[int, dict[str, Any]] = defaultdict(dict)
    for signal_id, values in sorted(decoded.items()):
        if signal_id in signals:  # Another program may have deleted it.
            name, kind = signals[signal_id]
            types.setdefault(signal_id, _type_of(values, kind))
            name = f"{name} ({signal_id})" if name.lower() in _FIXED else name
            metadata = {"signal_id": str(signal_id)}
            fields.append(arrow.field(name, types[signal_id], metadata=metadata))
            arrays.append(_array(values, name, types[signal_id], others))
    texts = [json.dumps(others[row]) if row in others else None for row in range(rows)]
    fields.append(arrow.field("others", arrow.string()))
    arrays.append(arrow.array(texts, arrow.string()))
    return arrow.table(arrays, schema=arrow.schema(fields))


def _type_of(values: Decoded, kind: str) -> Any:
    """Return the type of most values; without values, the type of the signal's kind."""
    codes = np.zeros(len(values.numbers), np.intp) if values.codes is None else values.codes
    counts = np.bincount(codes, minlength=len(values.labels) + FIRST_LABEL).tolist()
    found = Counter({"double": counts[IS_NUMBER]})
    for label, count in zip(values.labels, counts[FIRST_LABEL:], strict=True):
        found.update({name: count for name, held in _HELD.items() if isinstance(label, held)})
    ((most, count),) = found.most_common(1)
    return package("pyarrow").type_for_alias(
        most if count else {"bool": "bool", "text": "string"}.get(kind, "double")
    )


def _array(values: Decoded, name: str, kind: Any, others: dict[int, dict[str, Any]]) -> Any:
    """Return a column, and add values that it cannot hold to `others`."""
    arrow = package("pyarrow")
    held = _HELD.get(str(kind))
    codes = np.zeros(len(values.numbers), np.intp) if values.codes is None else values.codes
    fitting: list[Any] = [None, None]
    for code, label in enumerate(values.labels, FIRST_LABEL):
        fits = held is not None and isinstance(label, held)
        fitting.append(label if fits else None)
        for row in () if fits else np.flatnonzero(codes == code).tolist():
            others[row][name] = [label.why] if isinstance(label, Replaced) else label
    if held is None:
        return arrow.array(values.numbers, mask=codes != IS_NUMBER)
    for row in np.flatnonzero(codes == IS_NUMBER).tolist():
        others[row][name] = float(values.numbers[row])
    return arrow.array(fitting, kind).take(arrow.array(codes))


def chunks_of(held: Any, run_id: int | None) -> Iterator[PoolRow]:
    """Yield the rows of the table `chunk` that columns were made of, without ids."""
    names = table("chunk").columns
    groups = held.column("group_id").to_numpy()
    starts = [0, *(np.flatnonzero(np.diff(groups)) + 1).tolist()] if len(groups) else []
    for start, stop in zip(starts, [*starts[1:], len(groups)], strict=True):
        group = held.slice(start, stop - start).combine_chunks()
        texts = group.column("others").to_pylist()
        others = {row: json.loads(text) for row, text in enumerate(texts) if text}
        for field in group.schema:
            if (signal_id := _signal_of(field)) is None:
                continue
            values = _values(group.column(field.name), field.name, others)
            if values.codes is None or (values.codes != IS_ABSENT).any():
                row: dict[str, Any] = {"group_id": int(groups[start]), "run_id": run_id}
                row |= statistics_of(values)._asdict() | pack(values)._asdict()
                yield tuple((row | {"signal_id": signal_id}).get(name) for name in names)


def _signal_of(field: Any) -> int | None:
    if field.name in _PLACES:
        return _PLACES[field.name]
    metadata: Mapping[bytes, bytes] = field.metadata or {}
    signal_id = metadata.get(b"signal_id")
    return None if signal_id is None else int(signal_id)


def _values(column: Any, name: str, others: Mapping[int, Mapping[str, Any]]) -> Decoded:
    """Return the values of a column, whole numbers as integers, which take less space."""
    known: dict[tuple[type, Value | Replaced], int] = {}

    def code_of(label: Value | Replaced) -> int:
        return known.setdefault((type(label), label), len(known) + FIRST_LABEL)

    if str(column.type) in _HELD:
        listed = column.combine_chunks().dictionary_encode()
        found = [code_of(label) for label in listed.dictionary.to_pylist()]
        places = listed.indices.fill_null(len(found)).to_numpy()
        codes, numbers = np.array([*found, IS_ABSENT])[places], np.full(len(places), np.nan)
    else:
        numbers = np.array(column.to_numpy(), np.float64)
        codes = np.where(column.is_null().to_numpy(), IS_ABSENT, IS_NUMBER)
    for row in (row for row, other in others.items() if name in other):
        value = others[row][name]
        if isinstance(value, int | float) and not isinstance(value, bool):
            numbers[row], codes[row] = value, IS_NUMBER
        else:
            codes[row] = code_of(Replaced(value[0]) if isinstance(value, list) else value)
    for (_, label), code in known.items():
        if isinstance(label, bool):
            numbers[codes == code] = label
    held = numbers[codes == IS_NUMBER]
    signs = np.signbit(held[held == 0])  # An integer has no -0.0.
    is_whole = bool((np.trunc(held) == held).all() and not signs.any()) and (
        np.abs(held).max(initial=0) < 2.0**53
    )
    labels = [label for _, label in known]
    return Decoded(numbers, codes if codes.any() else None, labels, bool(is_whole))
