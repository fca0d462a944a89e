"""How the values of one signal over some rows become bytes, and values again.

Numbers are compressed by pcodec, which loses nothing. Each row has a code: it holds a number, or
its state lacks the signal, or it holds one of a few other values (a text, a flag, null), which
stand as JSON in a list of labels. Where every row holds a number there are no codes.
"""

from __future__ import annotations

import functools
import json
import zlib
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Final, NamedTuple, TypeAlias, cast

from webots_mcp.errors import DatabaseError
from webots_mcp.naming import Value
from webots_mcp.store.analysis.arrays import Array, Indexes, np

IS_NUMBER: Final = 0  # codes
IS_ABSENT: Final = 1
FIRST_LABEL: Final = 2  # and those above: the place of a label, counted from it on

_LEVEL: Final = 4  # of pcodec: a quarter of the time of its default, for 2 % more bytes
_CODES_LEVEL: Final = 1
_CHECKSUM_BYTES: Final = 4  # CRC-32: a decompressor is not asked what it makes of damaged bytes
MAX_TEXT: Final = 200  # characters of a text value that are kept and compared
EXACT_INTEGERS: Final = 2**53  # beyond, a float does not hold every integer
_FLOATS, _INTEGERS = "pcodec/float64", "pcodec/int64"
_NOTHING: Final = "none"  # no row holds a number
_NUMBERS: Final = frozenset({int, float})
_HOW_TO_INSTALL: Final = "install it: pip install --only-binary pcodec 'pcodec>=1.0'"


class Absent:
    """What a row has of a signal that its state lacks."""


class Replaced(NamedTuple):
    """What a row has where JSON cannot hold the value: why, such as nan or inf."""

    why: str


ABSENT: Final = Absent()
Recorded: TypeAlias = "Value | Absent | Replaced"


class DamagedChunkError(DatabaseError):
    """A chunk cannot be read; the text says why."""


class Encoded(NamedTuple):
    """The values of a signal as a row of the table `chunk` holds them.

    Attributes:
        codec: How `numbers` are compressed.
        numbers: Of the rows that hold one.
        codes: One for each row, compressed by zlib; None where every row holds a number.
        labels: JSON array of what codes from 2 on mean.
    """

    codec: str
    numbers: bytes | None
    codes: bytes | None
    labels: str | None


class Decoded(NamedTuple):
    """The values of a signal over some rows.

    Attributes:
        numbers: One for each row: NaN where it holds none; flags are 0 and 1.
        codes: One for each row; None where every row holds a number.
        labels: What codes from 2 on mean; of a replaced value `Replaced`.
        is_whole: All numbers were integers when they were stored.
    """

    numbers: Array
    codes: Indexes | None
    labels: Sequence[Value | Replaced]
    is_whole: bool = False


def decoded_of(values: Sequence[Recorded]) -> Decoded:
    """The same of values that were not stored: nothing is compressed."""
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


def encode(values: Sequence[Recorded]) -> Encoded:
    """Compress the values of some rows; see `pack`.

    What is lost: integers beyond 2^53 become floats, texts are cut after 200 characters, and where
    integers and floats are mixed all are floats.
    """
    return pack(decoded_of(values))


def pack(values: Decoded) -> Encoded:
    """Compress values that are numbers and codes already."""
    if values.codes is None:
        return Encoded(*_compressed(values.numbers, values.is_whole), None, None)
    listed = [[label.why] if isinstance(label, Replaced) else label for label in values.labels]
    width = np.uint8 if len(listed) + FIRST_LABEL < 2**8 else np.uint16
    return Encoded(
        *_compressed(values.numbers[values.codes == IS_NUMBER], values.is_whole),
        zlib.compress(values.codes.astype(width).tobytes(), _CODES_LEVEL),
        json.dumps(listed, separators=(",", ":"), ensure_ascii=False),
    )


def decode(encoded: Encoded, rows: int) -> Decoded:
    """The values of some rows.

    Raises:
        DamagedChunkError: The bytes are not what `encode` makes of so many rows.
    """
    try:
        if encoded.codes is None:
            numbers = np.empty(rows)
            _decompress(encoded, numbers)
            return Decoded(numbers, None, (), encoded.codec == _INTEGERS)
        return _decode_coded(encoded, rows)
    except ModuleNotFoundError as error:
        raise DamagedChunkError(
            f"chunks need {error.name}, which is missing: {_HOW_TO_INSTALL}"
        ) from None
    except DamagedChunkError:
        raise
    except Exception as error:  # whatever a library says of bytes that it did not make
        raise DamagedChunkError(f"damaged: {error}") from error


def _decode_coded(encoded: Encoded, rows: int) -> Decoded:
    assert encoded.codes is not None
    raw = zlib.decompress(encoded.codes)
    width: Any = np.uint8 if len(raw) == rows else np.uint16
    codes = np.frombuffer(raw, width).astype(np.intp)
    labels = _labels(encoded.labels)
    if len(codes) != rows or codes.max(initial=0) >= len(labels) + FIRST_LABEL:
        raise DamagedChunkError("damaged: its codes are not those of its rows")
    numbers = np.full(rows, np.nan)
    held = codes == IS_NUMBER
    if held.any():
        found = np.empty(int(held.sum()))
        _decompress(encoded, found)
        numbers[held] = found
    _fill_flags(numbers, codes, labels)
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
    """The code of each row, and the labels."""
    labels: list[Value | Replaced] = []
    known: dict[object, int] = {}  # a flag equals a number, so that the type is in the key
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
    """As floats; an integer that is too large for one becomes infinite."""
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
    """The library, which has no types; imported where the first chunk is made or read."""
    return import_module(module)


def _is_exact(numbers: Array) -> bool:
    """Whether these integers are the same as floats."""
    return bool(np.abs(numbers).max(initial=0) < EXACT_INTEGERS)


def _compressed(numbers: Any, is_whole: bool) -> tuple[str, bytes | None]:
    if not len(numbers):
        return _NOTHING, None
    codec = _INTEGERS if is_whole else _FLOATS
    config = _pcodec("pcodec").ChunkConfig(compression_level=_LEVEL)
    numbers = numbers.astype(np.int64) if is_whole else numbers
    packed = bytes(_pcodec().simple_compress(numbers, config))
    return codec, zlib.crc32(packed).to_bytes(_CHECKSUM_BYTES, "little") + packed


def _decompress(encoded: Encoded, into: Array) -> None:
    if encoded.codec not in (_FLOATS, _INTEGERS):
        raise DamagedChunkError(
            f"compressed by {encoded.codec!r}, which this version of webots-mcp does not know"
        )
    if encoded.numbers is None:
        raise DamagedChunkError("damaged: its numbers are missing")
    checksum, packed = encoded.numbers[:_CHECKSUM_BYTES], encoded.numbers[_CHECKSUM_BYTES:]
    if zlib.crc32(packed) != int.from_bytes(checksum, "little"):
        raise DamagedChunkError("damaged: its bytes do not match their checksum")
    whole: Any = into if encoded.codec == _FLOATS else np.empty(len(into), np.int64)
    progress = _pcodec().simple_decompress_into(packed, whole)
    if progress.n_processed != len(into) or not progress.finished:
        raise DamagedChunkError("damaged: it holds fewer numbers than its rows")
    if whole is not into:
        into[:] = whole
