"""Questions as a person types them: options and values, the answer, its words, what is refused."""

from __future__ import annotations

import re
import shlex
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Cli, line_with
from tests.recordings.rows import Recorded
from tests.server.story import copy_of
from webots_mcp.cli import app_for, described, names
from webots_mcp.cli.wording import as_typed, commands_by_tool

# What is typed about a recording of three runs, and what lines of the answer hold, as patterns.
ANSWERED = [
    ("runs", "robot rover.* controller rover.py", "^3 2023.* finished", "^2 2023.* crashed",
     "^1 2023.* reset.* log warning 1"),
    ("runs -n 1", "total 3, cursor 3"),
    ("history pose.0 mode --run 1 --points 8", "step_s 15", "pose.0 min .*pose.0 mean",
     "^52 back_up", r"gaps \[\[89.9, 95.0\]\]"),
    ("history pose.0 --last 0.3", "59.9 17.97", "sim_time_s pose.0 value$"),
    ("trends --run 1", "heading .*period 2 s", "mode .*cruise 76.9, avoid 35"),
    ("trends --run 1 -n 2", "7 of 9 numbers"),
    ("trends pose.0 --run 1 battery_v", "^pose.0 ", "^battery_v "),
    ("events --run 1 --kind stuck --kind gap", "stuck 40.*cruise", "gap 89.9"),
    ("events --run 1 --where 'pose.0 > 7.9 for 2'", "condition 41.6", "condition 97.6"),
    ("events --run 1 --where 'pose.0 > 7.9 and displacement(3) < 0.01'", "condition 43 9.1"),
    ("events --kind stuck", "nearest: stuck smallest movement"),
    ("compare", "commanded_m_s .*0.2.*0.3", "mean_speed_m_s .*0.2.*0.3"),
    ("compare 1 3", "signal mean .*effect", r"^run 3 \[3\]"),
    ("compare 1 -n 3 3", r"^run 3 \[3\]", "the 3 that differ most of 13"),
    ("first-difference 1 3", "controller_sha256 .*aaaaaaaaaa.*bbbbbbbbbb",
     "^verdict not alike to begin with"),
    ("first-difference 1 2 --signal 'pose*'", "different_before: began_by",
     "^verdict equal to the last digit in the 300",
     "row_count 300, signal_count 2, start_s 0, end_s 29.9",
     "one run goes on to 119.900 s"),
    ("signals --run 1", "pose.0 num .*12.78"),
    ("signals -n 1", "1 of 15: go on with --after"),
    ("sql 'SELECT id, label, 1e999 AS big FROM run ORDER BY id'", "id label big", "1 NULL inf"),
    ("sql 'SELECT id FROM run' -n 1", "only the first 1 rows"),
    ("sql 'SELECT id FROM run WHERE id > 99'", "no row"),
    ("logs --text fire", "no line matches"),
]  # fmt: skip
# What is typed about it, and what the line says that refuses it, in the words that were typed.
REFUSED = [
    ("history moed", "mode"),
    ("history mode --points 9999", "--points must be less than or equal to 500, not 9999"),
    ("history mode --run 99", "newest runs: 3, 2, 1"),
    ("history mode --after 3", "Add --raw, or leave cursor out"),
    ("trends --robot rovr", "Did you mean 'rover'"),
    ("trends --start 9 --end 3", "--start 9 must be less than --end 3"),
    ("trends --start 3 --last 3", "two ways"),
    ("trends --last 3 --since 0", "Use --start and --end (simulated seconds), or --last"),
    ("trends --last -3", "--last must be greater than 0, not -3"),
    ("trends lost_s", "'lost_s'"),
    ("events --kind explosion", "--kind must be one of"),
    ("events --after x", "--after 'x' is not a cursor"),
    ("compare 1 1", "1 to 300"),
    ("compare 77 78", "No run 77 is recorded. Use one of the newest runs: "),
    ("first-difference 1", "RUN"),
    ("first-difference 1 1", "two different runs"),
    ("first-difference 1 77", "No run 77"),
    ("first-difference 1 2 --signal moed", "mode"),
    ("compare 1 --first-difference", "needs exactly two runs, not [1]"),
    ("runs -n 501", "-n must be less than or equal to 500, not 501"),
    ("plot -o a.gif", ".png or .svg"),
    ("plot -o /no/such/folder/a.png", "cannot be written"),
    ("plot -o p.png --width 5000", "--width 5000 must be from 400 to 2000"),
    ("plot -o p.png --height 5", "--height 5 must be from 300 to 2000"),
    ("signals moed", "mode"),
    ("logs --last -3", "--last must be greater than 0, not -3.0"),
    ("logs --start 9 --end 3", "reversed"),
    ("logs --robot rovr", "Did you mean 'rover'"),
    ("logs --text \udcff", "--text must be a valid string"),
    ("logs --level loud", "--level"),
    ("sql 'DELETE FROM run'", "only one reading statement"),
    ("sql 'WITH a AS (SELECT 1) DELETE FROM run'", "Only reading is allowed"),
    ("sql 'SELECT lable FROM run'", "label"),
    ("annotate 1", "Give a label, a note or both"),
    ("annotate 99 x", "No run 99 is recorded. Use one of the newest runs: "),
    (f"annotate 1 {'x' * 101}", "at most 100"),
    ("annotate 1 \udcff", "TEXT must be a valid string"),
    ("annotate --note --raw", 'Invalid value "--raw" for --note'),
    ("step 0", "N must be greater than or equal to 1, not 0"),
    ("parameters --from-reset", "--from-reset needs what is set then: NAME=VALUE"),
    ("field ROVER.translation --stop", "--stop goes with a VALUE"),
    (f"tail -n {10**20} --no-follow", f"{10**20} is too large"),
    ("export -o x.zz", "or give --format"),
    ("send", 'Command "send" parameter ACTION requires an argument'),
    *((f"{name} -n {number}", number) for name in ("events", "tail") for number in ("-1", "1.5")),
    *(
        (asked.format(number), number)
        for asked in ("compare 1 {}", "annotate {} x", "trends --run {}", "wait {}", "report {}",
                      "plot -o a.png --run {}", "export --run {}", "export --trials {}")
        for number in (str(2**63), "1.5", "x")
    ),
]  # fmt: skip


@pytest.fixture
def told(story: Path, cli: Cli) -> Cli:
    return cli.on("--database", story)


@pytest.mark.parametrize(("typed", "patterns"), [(typed, words) for typed, *words in ANSWERED])
def test_a_person_reads_what_the_recording_holds(
    told: Cli, typed: str, patterns: list[str]
) -> None:
    lines = [" ".join(line.split()) for line in told(typed).splitlines()]
    for pattern in patterns:
        assert any(re.search(pattern, line) for line in lines), (pattern, lines)


@pytest.mark.parametrize(("typed", "words"), REFUSED)
def test_bad_input_is_one_line_and_exit_code_2(told: Cli, typed: str, words: str) -> None:
    said = told.refused(typed)
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("typed", ["runs", "trends", "events", "compare", "history mode"])
def test_json_is_one_object_for_other_programs(told: Cli, typed: str) -> None:
    answer = told.json(typed)
    assert isinstance(answer, dict) and answer


@pytest.mark.parametrize(("name", "start"), [("a.png", b"\x89PNG"), ("a.svg", b"<svg")])
def test_plot_writes_a_picture(told: Cli, tmp_path: Path, name: str, start: bytes) -> None:
    file = tmp_path / name
    assert str(file) in told(f"plot pose.0 --run 1 -o {file}")
    assert sys.platform == "win32" or stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_bytes().startswith(start)


@pytest.mark.parametrize(
    "typed", ["--runs 1 3 pose.0 -o {}", "-o {} --runs 1 3 pose.0", "pose.0 -o {} --runs 1 3"]
)
def test_a_plot_of_runs_takes_its_signal_wherever_it_stands(
    told: Cli, tmp_path: Path, typed: str
) -> None:
    said = told(f"plot {typed.format(tmp_path / 'a.png')}")
    assert "pose.0" in said and "run 1" in said and "run 3" in said


def test_a_person_reads_log_lines_whole_and_as_many_as_were_asked_for(
    tmp_path: Path, cli: Cli
) -> None:
    recording = Recorded(tmp_path / "webots.db")
    robot = recording.robot("rover")
    for number in range(100):
        robot.log(1.0, "x" * 1000 + f"end {number}")
    recording.close()
    rows = cli.json("logs -n 100")["lines"]["rows"]
    assert [row[-1][1000:] for row in rows] == [f"end {number}" for number in range(100)]


def test_a_label_is_given_shown_and_taken_away(story: Path, tmp_path: Path, cli: Cli) -> None:
    copy_of(story, tmp_path / "webots.db")
    given = cli("annotate 2 'kp 3' --note 'on ice'")
    assert "run_id 2, robot rover, label kp 3" in given and "note on ice" in given
    assert line_with(cli("runs"), "  2  kp 3", "on ice")
    run = cli.json("annotate 2 -")["run"]
    assert (run.get("label"), run["note"]) == (None, "on ice")
    cli("annotate 2 --note -")
    assert "on ice" not in cli("runs")
    cli("events --where '-pose.0 < 0'")


# -- words ----------------------------------------------------------------------------------------


def test_a_flag_that_is_to_be_turned_off_is_named_by_the_option_that_does(
    tmp_path: Path, cli: Cli
) -> None:
    recording = Recorded(tmp_path / "webots.db")
    rover = recording.robot("rover")
    for row in range(1200):
        rover.state(row * 0.1, {"front_m": None if row % 40 > 19 else 1.0})
    recording.close()
    said = " ".join(cli("events --kind missing").split())
    assert "--one-by-one tells alike events one by one" in said


def test_a_hint_names_commands_and_options_instead_of_tools_and_arguments() -> None:
    app_for(["send"])
    waits = "webots_wait_for_command(command_id=7)"
    hint = f"wait for it with {waits}, or ask with a longer timeout_wall_s"
    assert as_typed(hint) == "wait for it with 'webots-mcp wait 7', or ask with a longer --timeout"
    assert as_typed("webots_list_commands has it") == "'webots-mcp commands' has it"
    app_for(["trends"])
    quoted = "no signal 'last_s'; last_s=3 is too much since the start"  # a name of somebody's data
    assert as_typed(quoted) == "no signal 'last_s'; --last 3 is too much since the start"


def test_a_person_is_told_of_no_server_and_no_resource(tmp_path: Path, cli: Cli) -> None:
    said = cli.on("--data-dir", tmp_path).refused("status")
    assert "If controllers record elsewhere, give --data-dir or --database" in said
    assert "'.schema' in the sqlite3 shell" in described()["sql"].text


@pytest.mark.slow
def test_examples_can_be_typed() -> None:
    typed = [
        line.strip()
        for command in described().values()
        for line in command.text.splitlines()
        if line.startswith("    webots-mcp ")
    ]
    assert len(typed) > 15
    for line in typed:
        _, name, *given = shlex.split(line)
        app_for([name]).parse_args([name, *given], exit_on_error=False, print_error=False)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("signals", "'*' means any text. Default: all."),
        ("events", "Metres it may move meanwhile. Default: 0.05."),
    ],
)
def test_help_loses_no_word_and_no_default(cli: Cli, name: str, words: str) -> None:
    assert words in cli.on()(f"{name} --help")


# Fragments and private words that a help text once had.
UNCLEAR = re.compile(
    r"\b(so (much|many|long)|mends?|the way|looks? (at|for)|is told|tell clients|beside)\b",
    re.IGNORECASE,
)


def test_each_help_text_is_a_sentence_in_plain_words() -> None:
    for name, command in described().items():
        texts = [command.text, *command.arguments.values()]
        assert [text for text in texts if UNCLEAR.search(text)] == [], name
        assert [text for text in texts[1:] if not re.match(r"[A-Z.*'].*[.)]$", text)] == [], name
        summary = command.text.partition("\n\n")[0]
        assert summary.endswith(".") and len(summary) <= 100, name
        values = {option.partition(" ")[2] for typed in command.arguments
                  for option in typed.split(", ") if option.startswith("-")}  # fmt: skip
        assert values.isdisjoint({"INT", "STR", "FLOAT", "PATH"}), name


def test_a_hint_to_the_tool_that_steers_names_the_command_with_its_robot() -> None:
    hint = "Go on with webots_simulation_control(command='resume', robot='my rover')."
    assert as_typed(hint) == "Go on with 'webots-mcp resume --robot 'my rover''."
    assert as_typed("webots_simulation_control('step')") == "'webots-mcp step'"


def test_each_command_that_stands_for_a_tool_exists() -> None:
    commands = commands_by_tool()
    assert commands["list_robots"] == "status" and commands["run_trials"] == "trials"
    assert {command.partition(" ")[0] for command in commands.values()} <= {*names()}


@pytest.mark.slow
def test_questions_load_neither_the_server_nor_what_draws(story: Path) -> None:
    program = (
        "import sys\nfrom webots_mcp.cli import main\n"
        f"main(['trends', '--database', {str(story)!r}])\n"
        "print({'mcp', 'resvg_py', 'sqlmodel'} & set(sys.modules), file=sys.stderr)"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.stderr.strip() == "set()"


def test_hints_in_verdicts_are_typed_as_options(told: Cli) -> None:
    said = " ".join(told("events --run 1 --kind oscillation --kind change").split())
    assert "signals=[" not in said and "where='" not in said
