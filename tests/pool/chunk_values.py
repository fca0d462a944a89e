"""What chunks hold, whatever packed them: a pool may give them anew from the values."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from webots_mcp.plugins.pool.pool_interface import Row, table
from webots_mcp.store.chunks import SIM_TIMES, Encoded, Statistics, decode

NAMES = table("chunk").columns


def chunk_values(rows: Iterable[Row]) -> dict[tuple[int, int], Any]:
    """Of each group and signal what the rows of `chunk` say: statistics, and a value for each row.

    A row has a number, a label, or `Ellipsis` where its state lacks the signal.
    """
    chunks: list[dict[str, Any]] = [dict(zip(NAMES, row, strict=True)) for row in rows]
    lengths = {c["group_id"]: c["row_count"] for c in chunks if c["signal_id"] == SIM_TIMES}
    found: dict[tuple[int, int], Any] = {}
    for chunk in chunks:
        packed = Encoded(*(chunk[name] for name in Encoded._fields))
        values = decode(packed, lengths[chunk["group_id"]])
        codes = np.zeros(len(values.numbers), int) if values.codes is None else values.codes
        labels = [(type(each), each) for each in values.labels]
        listed = [
            repr(number) if code == 0 else [..., *labels][code - 1]
            for number, code in zip(values.numbers.tolist(), codes.tolist(), strict=True)
        ]
        figures = tuple(chunk[name] for name in Statistics._fields)
        found[chunk["group_id"], chunk["signal_id"]] = (chunk["run_id"], figures, listed)
    assert len(found) == len(chunks)
    return found
