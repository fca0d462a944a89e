"""Gaps of a long recording are found from its chunks as they are from its rows."""

from __future__ import annotations

from itertools import accumulate

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tests.memory import memory_connection
from tests.recordings.rover import start_run
from webots_mcp.analysis.arrays import rhythm_of
from webots_mcp.store import chunk_making
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading import frame_summary as reading
from webots_mcp.store.reading.frame import read_frame
from webots_mcp.store.reading.segment import Deadline, Segment

pytestmark = pytest.mark.slow


@pytest.fixture
def short_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks of sixteen rows, and no range in which every row is looked at."""
    monkeypatch.setattr(chunk_making, "GROUP_ROWS", 16)
    monkeypatch.setattr(reading, "FULL_ROWS", 0)


@pytest.mark.parametrize("interval_s", [0.5, 1.9, 3.2])
@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    gaps=st.dictionaries(st.integers(1, 299), st.floats(2.0, 200.0), max_size=8),
    start=st.floats(0, 0.5),
    end=st.floats(0.5, 1.2),
)
@example(gaps={16: 3.5}, start=0.0, end=1.0)  # between two chunks
def test_gaps_are_those_of_the_rows(
    short_chunks: None, interval_s: float, gaps: dict[int, float], start: float, end: float
) -> None:
    steps = [gaps.get(step, 1.0) * interval_s for step in range(300)]
    times = [round(time_s, 6) for time_s in accumulate(steps)]
    with memory_connection() as connection:
        recorder = start_run(connection)
        for time_s in times:
            recorder.publish(time_s, {"x": 1.0})
        make_chunks(connection, 100_000)
        segment = Segment(1, start * times[-1], end * times[-1])
        within = [time_s for time_s in times if segment.start_s <= time_s < segment.end_s]
        found = reading.rhythm_in(read_frame(connection, segment, Deadline(60)))
        expected = rhythm_of(within)
        assert found.interval_s == pytest.approx(expected.interval_s)
        assert found.gaps == expected.gaps
