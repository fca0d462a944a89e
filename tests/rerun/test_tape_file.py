"""A tape can be read whatever happened to its writer, and holds each line once."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

from webots_mcp.database.tapes.tape import MAGIC, TapeWriter, open_tape, tape_file
from webots_mcp.errors import InvalidInputError

WRITES_UNTIL_KILLED = """
import os, signal, sys
from pathlib import Path
from webots_mcp.database.tapes.tape import TapeWriter
writer = TapeWriter(Path(sys.argv[1]))
writer.write([["head", {}], ["call", 1, "robot", "Robot", "getTime", [], "question"]])
for number in range(int(sys.argv[2])):
    writer.write([["round", number, number / 10, "step", [100], 0, [1, number * 1.1]]])
os.kill(os.getpid(), signal.SIGKILL)
"""


def write(file: Path, rounds: int, close: bool = True) -> None:
    writer = TapeWriter(file)
    writer.write([["head", {}], ["call", 1, "robot", "Robot", "getTime", [], "question"]])
    for number in range(rounds):
        writer.write([["round", number, number / 10, "step", [100], 0, [1, number * 1.1]]])
    if close:
        writer.close("finished")


@pytest.mark.parametrize("rounds", [0, 1, 700, 5000])
def test_a_killed_process_leaves_each_round_that_it_has_ended(tmp_path: Path, rounds: int) -> None:
    file = tmp_path / "a.tape"
    command = [sys.executable, "-c", WRITES_UNTIL_KILLED, str(file), str(rounds)]
    subprocess.run(command, check=False)
    tape = open_tape(file)
    assert [each.events[1] for each in tape.rounds()] == [n * 1.1 for n in range(rounds)]
    assert tape.end is None


def test_a_kill_between_a_block_and_the_lines_it_replaces_doubles_nothing(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole.tape", tmp_path / "cut.tape"
    write(cut, 900, close=False)
    raw = cut.read_bytes()
    write(whole, 2000)
    packed = whole.read_bytes()
    end_of_block = packed.index(b"\0BLK", len(MAGIC) + 1)
    # A process that is killed before it cuts the file leaves the old lines behind the block.
    (tmp_path / "killed.tape").write_bytes(packed[:end_of_block] + raw[end_of_block:])
    numbers = [each.number for each in open_tape(tmp_path / "killed.tape").rounds()]
    assert numbers == list(range(len(numbers)))
    assert len(numbers) > 100


def test_numbers_come_back_to_the_last_digit(tmp_path: Path) -> None:
    values = [0.1 + 0.2, -0.0, 1e-308, float("inf"), 3, True, None, "\udc80", [1.5, "x"]]
    writer = TapeWriter(tmp_path / "a.tape")
    writer.write([["head", {}], ["round", 0, 0.0, "step", [32], 0, values]])
    writer.close("finished")
    (found,) = open_tape(tmp_path / "a.tape").rounds()
    assert repr(found.events) == repr(values)


def test_a_full_tape_says_so_and_takes_no_more(tmp_path: Path) -> None:
    writer = TapeWriter(tmp_path / "a.tape", max_bytes=2_000)
    writer.write([["head", {}]])
    for number in range(1000):
        writer.write([["round", number, 0.0, "step", [32], 0, ["x" * 50]]])
    assert not writer.is_open
    tape = open_tape(tmp_path / "a.tape")
    assert 5 < len(list(tape.rounds())) < 1000
    assert tape.end == "full"
    assert (tmp_path / "a.tape").stat().st_size < 3_000


def test_a_damaged_block_ends_the_tape_before_it(tmp_path: Path) -> None:
    file = tmp_path / "a.tape"
    write(file, 4000)
    content = bytearray(file.read_bytes())
    whole = len(list(open_tape(file).rounds()))
    content[-40] ^= 1
    file.write_bytes(content)
    read = [each.number for each in open_tape(file).rounds()]
    assert read == list(range(len(read)))
    assert len(read) < whole


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0", MAGIC, MAGIC + b"[0,1]\n"])
def test_what_is_no_tape_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.tape").write_bytes(content)
    with pytest.raises(InvalidInputError, match="tape"):
        open_tape(tmp_path / "a.tape")


def test_a_session_cannot_name_a_file_elsewhere(tmp_path: Path) -> None:
    assert tape_file(tmp_path, "../../etc/passwd").parent == tmp_path / "tapes"


def test_a_damaged_line_ends_the_tape_instead_of_shifting_its_rounds(tmp_path: Path) -> None:
    file = tmp_path / "a.tape"
    write(file, 20, close=False)
    lines = file.read_bytes().split(b"\n")
    lines[10] = lines[10].replace(b"[", b"(", 1)
    file.write_bytes(b"\n".join(lines))
    assert [each.number for each in open_tape(file).rounds()] == list(range(7))


def test_a_block_that_unpacks_to_too_much_is_not_read(tmp_path: Path) -> None:
    file = tmp_path / "a.tape"
    head = b'[0,"head",{"a":"' + b"x" * 40_000_000 + b'"}]\n'
    packed = zlib.compress(head)
    file.write_bytes(
        MAGIC + struct.pack(">4sII", b"\0BLK", len(packed), zlib.crc32(packed)) + packed
    )
    assert len(packed) < 100_000
    with pytest.raises(InvalidInputError, match="it has no head"):
        open_tape(file)


def test_a_head_of_another_form_is_refused(tmp_path: Path) -> None:
    writer = TapeWriter(tmp_path / "a.tape")
    writer.write([["head", {"devices": 3}]])
    with pytest.raises(InvalidInputError, match="'devices' of its head is wrong"):
        open_tape(tmp_path / "a.tape")


def test_lines_of_another_form_end_a_tape(tmp_path: Path) -> None:
    writer = TapeWriter(tmp_path / "a.tape")
    writer.write([["head", {}], ["round", 0, 0.1, "step", [], 0, []], ["round", 1], ["call", 1]])
    assert len(list(open_tape(tmp_path / "a.tape").rounds())) == 1
