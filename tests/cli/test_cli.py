"""The console commands, run as a person runs them."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded, RecordedRobot
from tests.waiting import wait_for
from webots_mcp.cli import described, main, names
from webots_mcp.cli.commands import EVERYDAY, FORMER_NAMES
from webots_mcp.database.queue import CommandQueue
from webots_mcp.store.logs import Follower


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    recording = Recorded(tmp_path / "webots.db")
    yield recording
    recording.close()


@pytest.fixture
def rover(recorded: Recorded) -> RecordedRobot:
    robot = recorded.robot(rows_waiting=4, rows_dropped=1, last_error="disk full")
    robot.state(1.5, {"mode": "cruise"})
    return robot


@contextmanager
def run(*arguments: str) -> Generator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-m", "webots_mcp", *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("name", [None, *names()])
def test_every_command_explains_itself(
    name: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        assert main([name, "--help"] if name else ["--help"]) == 0
    except SystemExit as ended:
        assert ended.code == 0
    text = capsys.readouterr().out
    assert "sage: webots-mcp" in text
    for each in EVERYDAY if name is None else ():
        assert each in text


def test_the_short_help_names_the_one_that_lists_every_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with contextlib.suppress(SystemExit):
        main(["--help"])
    short = capsys.readouterr().out
    assert "webots-mcp --help --all" in short and "first-difference" not in short
    with contextlib.suppress(SystemExit):
        main(["--help", "--all"])
    whole = capsys.readouterr().out
    assert [name for name in names() if name not in whole] == []


@pytest.mark.parametrize(("former", "name"), FORMER_NAMES.items())
def test_a_former_name_runs_the_command_and_tells_its_name_of_today(
    former: str, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.suppress(SystemExit):
        main([former, "--help"])
    said = capsys.readouterr()
    assert said.err == f"webots-mcp: {former!r} is now called {name!r}\n"
    assert f"webots-mcp {name}" in said.out


def test_no_help_has_words_that_are_taken_for_markup() -> None:
    for name, command in described().items():
        for text in (command.text, *command.arguments.values()):
            outside_of_code = re.sub(r"`[^`]*`", "", text)
            assert not re.search(r"<\w+>", outside_of_code), f"{name}: put it in backticks: {text}"


def test_the_help_of_launch_shows_which_controller_can_be_replaced(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with suppress(SystemExit):
        main(["launch", "--help"])
    assert "<extern>" in capsys.readouterr().out


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys, contextlib\nfrom webots_mcp.cli import main\n"
        "with contextlib.suppress(SystemExit): main(['--help'])\n"
        "heavy = {'mcp', 'sqlmodel', 'alembic', 'PIL'}\n"
        "heavy &= set(sys.modules)\n"
        "print(heavy, file=sys.stderr)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.stderr.strip() == "set()"


@pytest.mark.parametrize("option", ["--data-dir", "--database"])
def test_a_path_that_cannot_be_followed_is_one_line(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for path in ("~nobody-of-that-name/data", str(loop / "data")):
        assert main(["status", option, path]) != 0
        said = capsys.readouterr().err
        assert path in said and said.count("\n") == 1


def test_without_a_command_it_says_which_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "Start" in capsys.readouterr().out


def test_an_unknown_command_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fly"]) == 2
    assert 'Unknown command "fly"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["sttus"], "status"),
        (["run", "--untl", "x > 1"], "--until"),
        (["prun"], ""),
        (["run", "--rset"], ""),
        (["pause", "--forc"], ""),
        (["breakpoint", "--remov", "1"], ""),
        (["token", "--neww"], ""),
        (["report", "--overwrit"], ""),
    ],
)
def test_a_misspelled_command_or_option_is_offered_only_what_loses_nothing(
    typed: list[str], offered: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(typed) == 2
    said = capsys.readouterr().err
    assert ("Did you mean" in said) == bool(offered)
    assert offered in said


def test_status_tells_what_runs_and_what_could_not_be_recorded(
    rover: RecordedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--data-dir", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    for words in (
        str(tmp_path / "webots.db"),
        "Supervisor",
        "rows wait in the controller's memory",
        f"warning: {rover.name}: last error: ",
        "disk full",
        "rows could not be recorded",
    ):
        assert words in text
    (row,) = (line for line in text.splitlines() if line.startswith(f"{rover.name} "))
    assert row.split()[:4] == [rover.name, "running", str(rover.run_id), "1.5"]
    assert "states 1.00 GB" not in text
    for option in ("--storage", "--verbose"):
        assert main(["status", option, "--data-dir", str(tmp_path)]) == 0
        assert "states 1.00 GB" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["status"], ["tail"]])
def test_without_a_database_one_line_says_so_and_the_exit_code_is_2(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--data-dir", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("webots-mcp: no database at")
    assert said.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_tail_ends_with_the_newest_lines_of_every_kind(
    rover: RecordedRobot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rover.now += 1
    rover.log(2.0, "two\nlines", "warning")
    rover.now += 1
    rover.event(3.0, "change", "mode", {"from": "cruise", "to": "turn"})
    queue = CommandQueue(rover.connection, clock=lambda: rover.now + 1)
    command = queue.enqueue(rover.id, "go", {"x": 1})
    queue.cancel(command.id, "why not")
    assert main(["tail", "--no-follow", "--data-dir", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(maxsplit=2)[1] for line in lines] == ["rover"] * 5
    for line, words in zip(
        lines,
        ('{"mode": "cruise"}', r"two\nlines", "change mode", 'go {"x": 1}', "go cancelled why not"),
        strict=True,
    ):
        assert words in line


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for a child there")
def test_the_tail_follows_until_ctrl_c_and_says_so(rover: RecordedRobot, tmp_path: Path) -> None:
    with run("tail", "--interval", "0.05", "--data-dir", str(tmp_path)) as process:
        assert process.stdout is not None
        assert "cruise" in process.stdout.readline()
        rover.log(2.0, "it goes on", "error")
        assert "it goes on" in process.stdout.readline()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (130, "")
    database = tmp_path / "webots.db"
    assert err.splitlines() == [
        f"webots-mcp: following all robots in {database}; Ctrl-C stops it",
        "webots-mcp: ended by Ctrl-C",
    ]


def test_a_reader_that_has_seen_enough_ends_the_tail_quietly(
    rover: RecordedRobot, tmp_path: Path
) -> None:
    with run("tail", "--interval", "0.02", "--data-dir", str(tmp_path)) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        wait_for(lambda: rover.log(2.0, "into the void") and process.poll() is not None)
        assert process.stderr is not None
        assert (process.wait(timeout=30), process.stderr.read().count("\n")) == (0, 1)


@pytest.mark.usefixtures("rover")
def test_an_error_shows_its_place_and_the_recording_with_verbose(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    typed = ["history", "moed", "--data-dir", str(tmp_path)]
    assert main(typed) == 2
    short = capsys.readouterr().err
    assert main([*typed, "--verbose"]) == 2
    long = capsys.readouterr().err
    assert "Traceback" not in short and long.startswith(short)
    assert f"\nrecording: {tmp_path / 'webots.db'}\nTraceback " in long
    assert "UnknownSignalError: " in long


def test_an_argument_too_many_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "head", "now"]) == 2
    assert "status takes no further argument: 'head' 'now'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_server_keeps_stdout_for_the_protocol(tmp_path: Path) -> None:
    with run("serve", "--data-dir", str(tmp_path)) as process:
        out, err = process.communicate("", timeout=60)
    assert (process.returncode, out) == (0, "")
    assert "Traceback" not in err


def test_the_tail_of_one_robot_leaves_out_the_others(
    recorded: Recorded,
    rover: RecordedRobot,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recorded.robot("crane").log(1.0, "not mine")
    arguments = ["tail", "--no-follow", "--data-dir", str(tmp_path)]
    assert main([*arguments, "--robot", rover.name]) == 0
    assert "not mine" not in capsys.readouterr().out
    assert main([*arguments, "--robot", "rovr"]) == 2
    assert "Did you mean 'rover'" in capsys.readouterr().err
    assert main([*arguments, "-n", "0"]) == 0
    assert capsys.readouterr().out == ""
    assert main([*arguments, "--interval", "0"]) == 2


def test_a_follower_sees_each_line_once(rover: RecordedRobot) -> None:
    follower = Follower(rover.connection)
    assert [line.kind for line in follower.read_new()] == ["state"]
    assert follower.read_new() == []
    command = CommandQueue(rover.connection).enqueue(rover.id, "go")
    assert [line.text for line in follower.read_new()] == [f"#{command.id} go {{}}"]
    CommandQueue(rover.connection).cancel(command.id, "no")
    assert [line.text for line in follower.read_new()] == [f"#{command.id} go cancelled no"]
    assert follower.read_new() == []
