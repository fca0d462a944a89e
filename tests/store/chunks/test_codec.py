"""What a chunk gives back is what was put in, and damage is said, never guessed at."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.store.chunks import (
    ABSENT,
    DamagedChunkError,
    EncodedChunk,
    Replaced,
    decode,
    decoded_of,
    encode,
)

VALUES = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.integers(-(2**53) + 1, 2**53 - 1),
    st.booleans(),
    st.none(),
    st.text(max_size=30),
    st.just(ABSENT),
    st.sampled_from([Replaced("nan"), Replaced("inf")]),
)


@given(st.one_of(st.lists(VALUES, min_size=1), st.lists(st.floats(-1e9, 1e9), min_size=1)))
def test_what_is_decoded_is_what_was_encoded(values: list[Any]) -> None:
    given_, stored = decoded_of(values), decode(encode(values), len(values))
    assert [*stored.numbers.astype(str)] == [*given_.numbers.astype(str)]
    assert (stored.codes is None) == (given_.codes is None)
    assert stored.codes is None or (stored.codes == given_.codes).all()  # type: ignore[operator]
    assert list(map(repr, stored.labels)) == list(map(repr, given_.labels))


STORED_BY = {  # 0.0, 0.1, ... 1.1
    "1.0.0": "098065d870636f21030003030401060b0000a2999999999999fb0b10000000000000000000244000"
    "e0ffffffffffffff2f001032547698ba370f00",
    "1.1.0": "7fed417270636f21030003030401060b00001012020066666666666656403effffffffffffff7f02"
    "00000000000000809a9999999999b93f081e0000000000000000333333333333a33f9a9999999999"
    "e9cf999999999999e99f14000000000080fa0300",
}


@pytest.mark.parametrize("version", STORED_BY)
def test_what_a_version_of_pcodec_has_stored_every_other_one_reads(version: str) -> None:
    stored = EncodedChunk("pcodec/float64", bytes.fromhex(STORED_BY[version]), None, None)
    assert decode(stored, 12).numbers.tolist() == [round(0.1 * step, 1) for step in range(12)]


def test_a_flag_is_no_number_and_a_number_is_no_flag() -> None:
    stored = decode(encode([True, 1, 1.0, False, 0]), 5)
    assert list(stored.labels) == [True, False]
    assert stored.codes is not None
    assert stored.codes.tolist() == [2, 0, 0, 3, 0]
    assert stored.numbers.tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]


def test_an_integer_beyond_all_floats_is_infinite() -> None:
    assert decode(encode([1, 10**400]), 2).numbers.tolist() == [1.0, math.inf]


def test_rounded_measurements_take_less_than_two_bytes_each() -> None:
    values = [
        round(3 * math.sin(step / 200) + math.sin(step * step) / 100, 3) for step in range(1024)
    ]
    packed = encode(values).numbers
    assert packed is not None
    assert len(packed) < 2 * len(values)


@pytest.mark.parametrize("at", range(0, 200, 7))
def test_a_damaged_byte_is_noticed(at: int) -> None:
    whole = encode([0.1 * step for step in range(100)])
    assert whole.numbers is not None
    spoiled = bytearray(whole.numbers)
    spoiled[at % len(spoiled)] ^= 0x40
    with pytest.raises(DamagedChunkError, match="checksum"):
        decode(whole._replace(numbers=bytes(spoiled)), 100)


@pytest.mark.parametrize(
    ("values", "changes", "said"),
    [
        ([1.0, 2.0], {"codec": "pcodec2/float64"}, "does not know"),
        ([1.0, 2.0], {"numbers": None}, "missing"),
        (["a", "b"], {"codes": b"no zlib"}, "damaged"),
        (["a", "b"], {"labels": None}, "codes"),
        (["a", "b"], {"labels": "["}, "damaged"),
        (["a", "b"], {"labels": '"ab"'}, "no list"),
        (["a", "b"], {"labels": '[{"a": 1}, {}]'}, "not those of values"),
        (["a", "b"], {"labels": "[1, 2]"}, "not those of values"),
    ],
)
def test_what_another_version_or_program_wrote_is_said(
    values: list[Any], changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(DamagedChunkError, match=said):
        decode(encode(values)._replace(**changes), 2)


def test_fewer_numbers_than_rows_are_damage() -> None:
    with pytest.raises(DamagedChunkError, match=r"damaged|fewer"):
        decode(encode([1.0, 2.0, 3.0]), 5)
