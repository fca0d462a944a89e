"""What one row costs, whatever is published: counted by what was looked at, never by a clock."""

from __future__ import annotations

import ctypes
import itertools
import json
import math
import sqlite3
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.bridge.conftest import Recording
from tests.bridge.monsters import (
    MANY,
    MONSTERS,
    Endless,
    EndlessDict,
    EndlessList,
    Hidden,
    Lazy,
    Shy,
    circle,
    shared_dicts,
)
from webots_mcp import MCPBridge
from webots_mcp.bridge import encoding, json_cleaning
from webots_mcp.bridge.encoding import MAX_ROW_BYTES, Encoded
from webots_mcp.bridge.json_cleaning import MAX_NAMED
from webots_mcp.signals.register import StateChanges

POSE = [1.5, 2.5, 0.25]
MOST_LOOKED_AT = 20_000


def is_valid(text: str) -> bool:
    """Whether SQLite can read it as a JSON object."""
    connection = sqlite3.connect(":memory:")
    try:
        (kind,) = connection.execute("SELECT json_type(?)", (text,)).fetchone()
    finally:
        connection.close()
    return kind == "object"


def count_values(value: Any) -> int:
    inside: Any = value.values() if isinstance(value, dict) else value
    return 1 + sum(map(count_values, inside)) if isinstance(value, (dict, list)) else 1


def assert_bounded(encoded: Encoded) -> None:
    assert is_valid(encoded.text)
    assert len(encoded.text.encode()) <= MAX_ROW_BYTES
    assert count_values(json.loads(encoded.text)) <= MOST_LOOKED_AT + 1
    assert len(encoded.replaced) <= MAX_NAMED + 1
    assert len(encoded.replaced_text or "") <= 200_000


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_what_is_too_much_is_cut_and_named_and_the_rest_of_the_row_is_kept(
    make: Callable[[], Any],
) -> None:
    Lazy.asked = Endless.asked = EndlessList.asked = EndlessDict.asked = 0
    encoded = encoding.encode({"monster": make(), "pose": POSE})
    assert_bounded(encoded)
    assert json.loads(encoded.text)["pose"] == POSE
    asked = Lazy.asked + Endless.asked + EndlessList.asked + EndlessDict.asked
    assert asked <= 2 * MOST_LOOKED_AT
    if not asked or Lazy.asked:
        assert any(path == "monster" or path.startswith("monster.") for path in encoded.replaced)


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_a_monster_is_no_whole_state_either(make: Callable[[], Any]) -> None:
    monster = make()
    encoded = encoding.encode(monster)
    if isinstance(monster, Mapping):
        assert_bounded(encoded)
    assert len(encoded.text.encode()) <= MAX_ROW_BYTES


@pytest.mark.usefixtures("encoder")
def test_what_is_cut_is_counted_and_said_once(bridge: MCPBridge, recording: Recording) -> None:
    for _ in range(2):
        bridge.publish(
            {"l": circle(), "t": "x" * 200_000, "gaps": dict.fromkeys(range(900), math.nan)}
        )
    assert bridge.stats().values_replaced == 2 * 902
    (replaced, _) = [
        json.loads(replaced) for replaced in recording.rows("SELECT replaced FROM state")
    ]
    assert replaced["t"] == "too large"
    assert set(replaced.values()) == {"too deep", "too large", "nan"}
    logged = recording.rows("SELECT message FROM log WHERE source = 'bridge'")
    assert len(logged) == 2
    assert "t could not be stored whole: too large" in logged


@pytest.mark.usefixtures("encoder")
def test_more_than_a_thousand_odd_values_are_counted(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.publish({"gaps": dict.fromkeys(range(2000), math.nan)})
    (replaced,) = [
        json.loads(replaced) for replaced in recording.rows("SELECT replaced FROM state")
    ]
    assert len(replaced) == 1001
    assert replaced[""] == "1000 more"
    assert bridge.stats().values_replaced == 2000
    logged = recording.rows("SELECT message FROM log WHERE source = 'bridge'")
    assert logged == ["state could not be stored: 1000 more"]


@pytest.mark.usefixtures("encoder")
def test_a_row_as_large_as_the_table_says_is_stored_whole() -> None:
    state = {
        "scan": [0.123456789] * 10_000,
        "links": {f"link{i}": {"x": 0.5, "ok": True, "n": None} for i in range(450)},
        "note": "ä" * 50_000,
    }
    text, replaced, _ = encoding.encode(state)
    assert json.loads(text) == state
    assert replaced == {}


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("depth", [19, 20, 21])
def test_twenty_levels_are_kept_with_and_without_odd_values(depth: int) -> None:
    value: Any = 0.5
    for _ in range(depth - 1):
        value = [value]
    for gap in ({}, {"gap": math.nan}):
        replaced = encoding.encode({"a": value, **gap}).replaced
        assert ("too deep" in replaced.values()) == (depth > 20)


def test_a_state_of_plain_values_is_looked_at_once_and_never_copied(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(encoding, "Cleaner", None)
    state = {"pose": POSE, "p": np.float64(1.5), "mode": "cruise", "grid": [[1, 2], [3, 4]]}
    assert json.loads(encoding.encode(state).text) == {**state, "p": 1.5}


class LidarPoint:
    """As in Webots: nothing but attributes."""

    def __init__(self) -> None:
        self.x, self.layer, self.time = 0.5, 1, 0.032


class Tensor:
    """An array of another library, whose size is a method."""

    shape = (2,)

    def size(self) -> tuple[int]:
        return (2,)

    def tolist(self) -> list[int]:
        return [1, 2]


class Mute:
    """A key without a text."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


class Unreadable(dict[str, int]):
    def items(self) -> Any:
        raise RuntimeError("no items")

    __iter__ = keys = values = items


# What is published, what is stored of it, and what is said to be replaced.
STORED: dict[str, tuple[Any, object, dict[str, str]]] = {
    "lidar": ({"p": [LidarPoint()]}, {"p": [{"x": 0.5, "layer": 1, "time": 0.032}]}, {}),
    "tensor": ({"t": Tensor()}, {"t": [1, 2]}, {}),
    "long double": ({"a": np.longdouble(0.5)}, {"a": 0.5}, {}),
    "long doubles": ({"a": np.array([0.25], np.longdouble)}, {"a": [0.25]}, {}),
    "large int": ({"a": 2**100, "b": math.nan}, {"a": 2.0**100, "b": None}, {"b": "nan"}),
    "gaps": (
        {"scan": [0.5, math.inf, math.nan]},
        {"scan": [0.5, None, None]},
        {"scan.1": "inf", "scan.2": "nan"},
    ),
    "mute key": (
        {"a": {Mute(): 2, 3: 4}},
        {"a": {"<Mute>": 2, "3": 4}},
        {"a.<Mute>": "unsupported: Mute"},
    ),
    "map": (
        {"map": [[[1, 2]] * 100] * 100, "image": [[0] * 200 for _ in range(200)]},
        {"map": None, "image": None},
        {"map": "too large", "image": "too large"},
    ),
    "unreadable": (Unreadable(x=1), {}, {"": "unsupported: Unreadable"}),
    "long text": ({"t": "ab" * 100_000}, {"t": "ab" * 50_000}, {"t": "too large"}),
    "long key": ({"k" * 300: 1}, {"k" * 200: 1}, {"k" * 200: "too large"}),
    "int key": ({10**4000: 1}, {"<int>": 1}, {"<int>": "unsupported: int"}),
    "tuple key": ({tuple(range(100_000)): 1}, {"<tuple>": 1}, {"<tuple>": "unsupported: tuple"}),
    "many keys": (
        {f"key{i}": i for i in range(MANY)},
        {f"key{i}": i for i in range(1000)},
        {"": "too large"},
    ),
}


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize(("state", "stored", "replaced"), STORED.values(), ids=STORED)
def test_what_json_does_not_know_is_stored_as_what_it_means_or_named(
    state: Any, stored: object, replaced: dict[str, str]
) -> None:
    encoded = encoding.encode(state)
    assert (json.loads(encoded.text), encoded.replaced) == (stored, replaced)


LEAVES: st.SearchStrategy[Any] = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(st.characters(exclude_categories=()))
    | st.binary(max_size=8)
    | st.sampled_from(
        [10**400, -(2**63), 2**64, object(), Lazy(), Shy(), Hidden(circle), Hidden(shared_dicts)]
    )
    | st.builds(np.float32, st.floats(width=32))
    | st.builds(ctypes.c_double, st.floats())
    | st.integers(0, 25_000).map(lambda count: Hidden(lambda: [0.5] * count))
    | st.integers(0, 200_000).map(lambda count: Hidden(lambda: "ä" * count))
)
KEYS: st.SearchStrategy[Any] = (
    st.text(st.characters(exclude_categories=())) | st.integers() | st.none() | st.binary()
)


def repeated(item: Any, count: int) -> list[Any]:
    return [item] * count


VALUES: st.SearchStrategy[Any] = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(KEYS, inner, max_size=4)
        | st.builds(repeated, inner, st.integers(0, 300))
    ),
    max_leaves=20,
)


@pytest.mark.slow
@settings(deadline=None)
@given(st.dictionaries(KEYS, VALUES, max_size=5), st.booleans())
def test_whatever_is_published_sqlite_can_read_it_and_it_is_bounded_and_what_is_odd_is_named(
    state: dict[Any, Any], with_orjson: bool
) -> None:
    Lazy.asked = 0
    with pytest.MonkeyPatch.context() as patch:
        if not with_orjson:
            patch.setattr(encoding, "orjson", None)
        patch.setattr(json_cleaning, "OBJECTS_BUDGET_S", math.inf)
        encoded = encoding.encode(state)
        stored = json.loads(encoded.text)
        again = encoding.encode(stored)
    assert_bounded(encoded)
    assert Lazy.asked <= 2 * MOST_LOOKED_AT
    if not {"too large", "too deep"}.intersection(encoded.replaced.values()):
        assert json.loads(again.text) == stored
        assert again.replaced == {}


NUMBERS: st.SearchStrategy[Any] = st.sampled_from(
    [0.5, math.inf, -math.inf, math.nan, None, "null", 7, np.float64(math.inf), [0.5, math.inf]]
)
PARTS: st.SearchStrategy[Any] = st.recursive(
    NUMBERS | st.lists(st.sampled_from([0.5, math.inf, -math.inf, math.nan, 3]), max_size=3),
    lambda inner: st.dictionaries(st.sampled_from(["a", "b", "a.b", "*", "0", 0]), inner),
    max_leaves=8,
)


@pytest.mark.slow
@settings(deadline=None)
@given(
    st.lists(st.dictionaries(st.sampled_from(["a", "b", "a.b", 0]), PARTS), max_size=6),
    st.booleans(),
)
def test_rows_are_the_same_whatever_the_rows_before_had_in_place_of_numbers(
    states: list[dict[Any, Any]], with_orjson: bool
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        if not with_orjson:
            patch.setattr(encoding, "orjson", None)
        encode_alone = encoding._clean_and_encode  # pyright: ignore[reportPrivateUsage]
        for state in [*states, *states]:
            before = repr(state)
            encoded, alone = encoding.encode(state), encode_alone(state)
            assert json.loads(encoded.text) == json.loads(alone.text)
            assert (encoded.replaced, encoded.unnamed) == (alone.replaced, alone.unnamed)
            assert repr(state) == before


@pytest.mark.usefixtures("encoder")
def test_infinities_at_places_that_had_them_before_are_not_looked_for_with_the_slow_encoder(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def row(left: float | None, right: float, near: list[float | None]) -> dict[str, Any]:
        return {"motors": {"l": {"target": left}, "r": {"target": right}}, "near": near}

    encoding.encode(row(math.inf, math.nan, [0.5, math.inf]))
    monkeypatch.setattr(encoding, "Cleaner", None)
    again = encoding.encode(row(-math.inf, 2.0, [math.nan, 0.25]))
    assert json.loads(again.text) == row(None, 2.0, [None, 0.25])
    assert again.replaced == {"motors.l.target": "-inf", "near.*": "nan"}
    other = {"mode": "rest"}
    assert encoding.encode(other) == ('{"mode":"rest"}', {}, 0)


class Unending(Mapping[str, object]):
    """Says that it is small, and never comes to its end."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, key: str) -> object:
        return True

    def __iter__(self) -> Iterator[str]:
        return (f"key {n}" for n in itertools.count())


def test_a_state_that_never_comes_to_its_end_is_recorded_as_far_as_it_says(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.publish(Unending())
    assert recording.states() == [{"key 0": True, "key 1": True, "key 2": True}]


class Computed(dict[str, object]):
    """A dict that holds nothing itself."""

    def items(self) -> Any:
        return [("left", 1), ("right", 2)]


@pytest.mark.parametrize("state", [Computed(), {"wheels": Computed()}, {"wheels": [Computed()]}])
def test_a_mapping_is_recorded_by_its_own_items_whatever_it_holds(
    bridge: MCPBridge, recording: Recording, state: dict[str, Any]
) -> None:
    bridge.publish(state)
    wheels = {"left": 1, "right": 2}
    assert recording.states() in ([wheels], [{"wheels": wheels}], [{"wheels": [wheels]}])


class NeverEnding(dict[str, object]):
    """A dict whose items never end."""

    def items(self) -> Any:
        return ((i, i) for i in itertools.count())


class FailsMidway(dict[str, object]):
    """A dict that cannot read all of its items, and whose keys need not be hashable."""

    def items(self) -> Any:
        yield "left", 1
        yield ["right"], 2
        raise OSError("the bus is off")


@pytest.mark.parametrize(
    ("mapping", "stored", "named"),
    [
        (NeverEnding(a=1), {"0": 0}, "too large"),
        (FailsMidway(), {"left": 1, "['right']": 2}, "unsupported: FailsMidway"),
    ],
)
def test_what_a_mapping_does_not_give_is_named_and_the_rest_is_recorded(
    bridge: MCPBridge,
    recording: Recording,
    mapping: dict[str, object],
    stored: dict[str, object],
    named: str,
) -> None:
    bridge.publish({"wheels": mapping})
    assert recording.states() == [{"wheels": stored}]
    (replaced,) = recording.rows("SELECT replaced FROM state")
    assert json.loads(replaced) == {"wheels": named}


def test_what_is_added_to_the_devices_may_never_come_to_its_end_either(
    bridge: MCPBridge, recording: Recording
) -> None:
    bridge.auto_publish(Unending())
    (state,) = recording.states()
    assert {key for key in state if key.startswith("key")} == {"key 0", "key 1", "key 2"}


def test_keys_that_are_new_in_every_state_do_not_fill_the_memory() -> None:
    changes = StateChanges()
    tracemalloc.start()
    try:
        for n in range(20_000):
            assert not list(changes.compare({f"seen at {n}": "yes"}))
        held_bytes, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held_bytes < 500_000


@pytest.mark.usefixtures("encoder")
def test_objects_that_take_too_long_cost_themselves_only(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(json_cleaning, "OBJECTS_BUDGET_S", -1.0)
    encoded = encoding.encode({"a": [Decimal(1), Decimal(2)], "b": {"c": 2.5}, "d": math.nan})
    assert json.loads(encoded.text)["b"] == {"c": 2.5}
    assert encoded.replaced["a.1"] == "too large"
    assert encoded.replaced["d"] == "nan"


class Counted:
    """An array of numbers that counts how often it is read."""

    read = 0

    def __init__(self, size: int, nbytes: int) -> None:
        self._size = size
        self.nbytes = nbytes

    def __len__(self) -> int:
        return self._size

    def tolist(self) -> list[float]:
        Counted.read += 1
        return [1.0] * self._size


@pytest.mark.usefixtures("encoder")
def test_arrays_that_there_is_no_room_for_are_not_read() -> None:
    Counted.read = 0
    encoded = encoding.encode({"a": [Counted(15_000, 120_000) for _ in range(500)]})
    assert Counted.read <= 4
    assert encoded.replaced["a.499"] == "too large"
    few = encoding.encode({"a": Counted(10, 40_000_000)})
    assert Counted.read <= 4
    assert few.replaced == {"a": "too large"}


@pytest.mark.usefixtures("encoder")
def test_values_that_are_few_enough_are_bounded_by_the_bytes_of_their_row() -> None:
    texts = {"\U0001f600" * 56 + f"{number:04}": "\U0001f600" * 15 for number in range(3_900)}
    assert sum(len(f"{key}{text}".encode()) for key, text in texts.items()) > MAX_ROW_BYTES
    assert_bounded(encoding.encode(texts))


def test_many_mappings_without_end_cost_no_more_than_one_row() -> None:
    EndlessDict.asked = 0
    encoded = encoding.encode({"monsters": [EndlessDict(a=1) for _ in range(500)], "pose": POSE})
    assert EndlessDict.asked <= 2 * MOST_LOOKED_AT
    assert json.loads(encoded.text)["pose"] == POSE
    assert_bounded(encoded)


def test_a_dict_that_changes_while_it_is_read_costs_itself_only() -> None:
    wheels: dict[str, Any] = {"left": math.nan, "right": 2.5}

    class Growing:
        """Adds to the dict that it is in, as another thread might."""

        def tolist(self) -> float:
            wheels[f"wheel {len(wheels)}"] = 1.0
            return 0.5

    wheels["middle"] = Growing()
    wheels["last"] = 1.5
    encoded = encoding.encode({"wheels": wheels, "pose": POSE})
    assert json.loads(encoded.text)["pose"] == POSE
    assert json.loads(encoded.text)["wheels"] == {"left": None, "right": 2.5, "middle": 0.5}
    assert encoded.replaced == {"wheels": "unsupported: dict", "wheels.left": "nan"}


KINDS = {"nan", "inf", "-inf", "too large", "too deep"}


@pytest.mark.usefixtures("encoder")
@pytest.mark.parametrize("make", MONSTERS.values(), ids=MONSTERS)
def test_few_kinds_say_what_was_replaced(make: Callable[[], Any]) -> None:
    encoded = encoding.encode({"monster": make(), "raw": b"\1", "text": "\ud800"})
    named = {path: kind for path, kind in encoded.replaced.items() if path}
    assert all(kind in KINDS or kind.startswith("unsupported: ") for kind in named.values())
