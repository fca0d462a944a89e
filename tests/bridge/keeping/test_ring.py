"""The ring holds the newest calls as they would be recorded, in bounded memory."""

from __future__ import annotations

import json
import math
import sys
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.bridge.conftest import STEP_MS, Recording
from tests.bridge.keeping.conftest import State, rows
from tests.bridge.monsters import MONSTERS, EndlessDict
from webots_mcp import MCPBridge
from webots_mcp.bridge import json_cleaning
from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.ring import Ring, RingRow
from webots_mcp.bridge.state_pickles import copy_or_encode, encode_copy
from webots_mcp.standin import InProcessSupervisor


class Measured(float):
    """A float to whoever adds it up."""


class Hailed(bytearray):
    """Holds bytes, and adds up to a float."""

    def __radd__(self, other: float) -> float:
        return other


def long_array(last: object) -> list[Any]:
    return [*[0.5] * 17, last, 1.5]


KEYS = st.one_of(
    st.text(max_size=3),
    st.sampled_from([1, 1.0, True, None, np.int64(1), np.float64(1), np.str_("a"), "a", "\ud800"]),
)
LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(),
    st.text(st.characters(codec=None), max_size=4),
    st.sampled_from([np.float64(2.5), np.float32(0.1), np.str_("b"), Measured(3.5), b"\0\1"]),
    st.sampled_from([Measured(1), np.float64(7.5), Hailed(b"abc"), None, 2, "x"]).map(long_array),
    st.builds(np.array, st.lists(st.floats(width=32), max_size=3)),
)
STATES = st.dictionaries(
    KEYS,
    st.recursive(
        LEAVES,
        lambda inside: (
            st.lists(inside, max_size=4)
            | st.tuples(inside, inside)
            | st.frozensets(st.text(max_size=2), max_size=3)
            | st.dictionaries(KEYS, inside, max_size=4)
        ),
        max_leaves=12,
    ),
    max_size=6,
)


@pytest.mark.slow
@given(state=STATES)
@pytest.mark.usefixtures("encoder")
def test_any_state_that_is_held_is_kept_as_it_would_be_recorded(state: State) -> None:
    expected = encode(state)
    held = copy_or_encode(state)
    state.clear()
    assert (encode_copy(held) if isinstance(held, bytes) else held) == expected


@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_a_monster_that_is_held_is_kept_as_it_would_be_recorded(
    make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(json_cleaning, "OBJECTS_BUDGET_S", math.inf)
    EndlessDict.asked = 0
    held = copy_or_encode({"monster": make()})
    kept = encode_copy(held) if isinstance(held, bytes) else held
    EndlessDict.asked = 0
    assert kept == encode({"monster": make()})


def test_what_the_controller_changes_after_its_call_does_not_change_what_is_kept(
    robot: InProcessSupervisor, bridge: MCPBridge, recording: Recording
) -> None:
    state: State = {"n": 0, "pose": [0, {"x_m": 0.0}]}
    for number in range(9):
        robot.step(STEP_MS)
        state["n"] = state["pose"][0] = state["pose"][1]["x_m"] = number
        bridge.publish(state)
    bridge.keep("a look")
    bridge.close()
    kept = map(json.loads, recording.rows("SELECT data FROM kept_state ORDER BY sim_time_s"))
    assert [*kept] == [{"n": n, "pose": [n, {"x_m": n}]} for n in range(9)]


@given(rows=rows, most_bytes=st.integers(0, 20_000), last_s=st.floats(0.1, 10))
@example(rows=[(1.0, "a"), (1.0, "b")], most_bytes=20_000, last_s=1.0)
def test_a_ring_never_takes_more_memory_or_time_than_it_may_and_holds_the_newest(
    rows: list[tuple[float, str | bytes]], most_bytes: int, last_s: float
) -> None:
    ring, now_s, given_rows = Ring(last_s, most_bytes), 0.0, list[RingRow]()
    for call, (step_s, text) in enumerate(rows):
        now_s += step_s
        given_rows.append(RingRow(call, now_s, 0.0, text, None, 400 + len(text)))
        ring.add(given_rows[-1])
        assert ring.size_bytes <= most_bytes
    held = ring.take()
    assert held == given_rows[len(given_rows) - len(held) :]
    assert all(row.sim_time_s >= now_s - last_s for row in held)
    fits = list[RingRow]()
    for row in reversed(given_rows):
        if row.sim_time_s < now_s - last_s:
            break
        if sum(each.size_bytes for each in [row, *fits]) > most_bytes:
            break
        fits.insert(0, row)
    assert held == fits
    assert ring.size_bytes == 0


STATES_TO_HOLD: dict[str, Callable[[int], State]] = {
    "numbers": lambda n: {"lidar": [number / 7 for number in range(n, n + 200)]},
    "one number": lambda n: {"n": n},
    "texts": lambda n: {"said": "\U0001f916" * (n % 100), "more": [None] * (n % 50)},
    "arrays of numpy": lambda n: {"lidar": np.arange(n, n + 50) / 7},
}


@pytest.mark.parametrize("make_state", STATES_TO_HOLD.values(), ids=STATES_TO_HOLD)
def test_what_a_ring_holds_takes_no_more_memory_than_it_says(
    make_state: Callable[[int], State],
) -> None:
    ring = Ring(1000, 300_000)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for number in range(1200):
            held, replaced = copy_or_encode(make_state(number)), None
            if not isinstance(held, bytes):
                held, replaced = held.text, held.replaced_text
            size_bytes = 400 + sys.getsizeof(held)
            ring.add(RingRow(number, number / 100, number + 0.5, held, replaced, size_bytes))
        taken, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(ring) > 50
    assert taken - before <= 300_000
