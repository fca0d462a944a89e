"""What a recording holds is shown on a terminal, and never obeyed by it."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main
from webots_mcp.cli.streams import progress_bar, rewrite, shown_progress, spelling_out
from webots_mcp.cli.terminal import answer_lines

# Sets the title of the terminal, clears it in one character (C1), and turns what follows round.
HOSTILE = "a\x1b]0;owned\x07\x9b2J\u202egnp.exe\u2066\u200f"
OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Recorded]:
    monkeypatch.chdir(tmp_path)
    recording = Recorded(tmp_path / "webots.db")
    robot = recording.robot(HOSTILE)
    for step in range(20):
        state = {HOSTILE: step, "mode": HOSTILE, "x": step, "y": -step, "f": step % 2 == 0}
        robot.state(step / 10, {**state, "kind": f"{HOSTILE}{step // 9}"})
    robot.log(1.0, HOSTILE, level="error")
    recording.connection.execute("UPDATE run SET label = ?, note = ?", (HOSTILE, HOSTILE))
    recording.connection.execute("UPDATE session SET last_error = ?", (f"{HOSTILE}\nmore",))
    yield recording
    recording.close()


COMMANDS = [
    ["status"],
    ["status", "--json"],
    ["tail", "--no-follow"],
    ["runs"],
    ["runs", "--json"],
    ["signals"],
    ["history", "*"],
    ["history", "*", "--json"],
    ["trends"],
    ["trends", "--json"],
    ["events"],
    ["events", "--json"],
    ["compare", "1"],
    ["logs"],
    ["logs", "--json"],
    ["history", HOSTILE],
    ["sql", "SELECT data FROM state"],
    ["sql", "SELECT name FROM robot", "--json"],
    ["plot", "*", "-o", "x.svg"],
    ["plot", "--trajectory", "-o", "x.svg"],
    ["report", "-o", "x.html"],
    ["history", "nothing"],
]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(map(ascii, command)))
def test_no_command_lets_a_recording_steer_the_terminal(
    recorded: Recorded, command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    main([*command, "--database", "webots.db"])
    said = capsys.readouterr()
    assert said.out or said.err
    assert not OBEYED.search(said.out + said.err), ascii(said)


def test_pictures_and_reports_are_files_that_nothing_turns_round(recorded: Recorded) -> None:
    for more in ([], ["--trajectory"]):
        assert main(["plot", *more, "-o", "x.svg", "--database", "webots.db"]) == 0
        text = Path("x.svg").read_text("utf-8")
        assert not OBEYED.search(text)
        ElementTree.fromstring(text)
    assert main(["report", "-o", "x.html", "--database", "webots.db"]) == 0
    text = Path("x.html").read_text("utf-8")
    assert not OBEYED.search(text)
    assert "\\u202e" in text
    data = text[text.rindex("<script") :]
    assert not re.search(r"(?<!\\)\\u202e", data), "a figure would show it"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_exported_data_is_shown_so_as_well_and_progress_stays_one_line(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = Terminal()
    monkeypatch.setattr("sys.stdout", shown)
    assert main(["export", "--database", "webots.db"]) == 0
    assert shown.getvalue().startswith("run")
    assert not OBEYED.search(shown.getvalue().replace("\r\n", "\n"))
    with spelling_out():
        import sys

        rewrite(sys.stdout, HOSTILE)
        assert shown.getvalue().endswith("\x1b[K")
        print("\rgone")
    assert shown.getvalue().endswith("\\u000dgone\n")


def test_where_no_terminal_is_long_work_says_how_far_it_is_by_a_line_every_few_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 0.0
    monkeypatch.setattr("webots_mcp.cli.streams.time.monotonic", lambda: now_s)
    with shown_progress("making chunks") as progress:
        for done in range(32):  # for 8 s
            progress(done, 32)
            now_s += 0.25
    said = capsys.readouterr()
    assert said.err.splitlines() == [
        "webots-mcp: making chunks: 37 %",
        "webots-mcp: making chunks: 75 %",
    ]
    assert said.out == ""


def test_short_work_is_silent_where_no_terminal_is(capsys: pytest.CaptureFixture[str]) -> None:
    with shown_progress("making chunks") as progress:
        progress(1, 2)
        progress(2, 2)
    assert capsys.readouterr().err == ""


def test_texts_within_parts_are_no_wider_than_the_terminal() -> None:
    answer = {"verdicts": {"nearest": {"stuck": "smallest movement " * 12}, "found": "jump"}}
    assert max(map(len, answer_lines(answer, width=60))) <= 60


def test_a_bar_shows_how_much_is_done() -> None:
    assert progress_bar(0, 40) == "[....................] "
    assert progress_bar(10, 40) == "[#####...............] "
    assert progress_bar(50, 40) == "[####################] "
