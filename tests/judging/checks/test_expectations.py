"""What is expected is asked live and of the past, with the same outcome, and judges a run."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from mcp import Client

from tests.recordings.rover import Recorder, start_run
from webots_mcp import MCPBridge
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.errors import InvalidConditionError, InvalidInputError, UnknownSignalError
from webots_mcp.judging.checks.check_run import check_run
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection.event_options import EventOptions
from webots_mcp.judging.detection.events import find_events
from webots_mcp.judging.run_score import score_run
from webots_mcp.server.mcp_server import create_server
from webots_mcp.signals.conditions.expectation import read_expectation
from webots_mcp.standin import InProcessSupervisor
from webots_mcp.store.project_file import ProjectWatch, read_project
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.testing import RobotRecording

STEP_MS = 16
KEEPS = {"during": "mode == 'drive'", "name": "keeps its distance"}
# front_m in each state, and the mode: two violations while it drives, one that lasts three states.
FRONTS = [None, 0.5, 0.05, 0.5, 0.4, 0.09, 0.08, 0.07, 0.3, 0.05]
MODES = ["drive"] * 9 + ["dock"]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for folder in ("worlds", "controllers", "mcp_data"):
        (tmp_path / folder).mkdir()
    return tmp_path


def drive(
    file: Path, states: list[dict[str, Any]], *expected: dict[str, Any], every: int = 1
) -> None:
    """A controller that expects something and publishes these states, then ends."""
    robot = InProcessSupervisor("rover")
    bridge = MCPBridge(robot, throttle_interval=every, database=file)
    for each in expected:
        bridge.expect(**each)
    for state in states:
        robot.step(STEP_MS)
        bridge.publish(state)
    bridge.close()


STATES = [{"front_m": front, "mode": mode} for front, mode in zip(FRONTS, MODES, strict=True)]


def lines(file: Path, run_id: int = 1, **asked: Any) -> dict[str, tuple[str, str]]:
    """Outcome and evidence of each expectation."""
    with closing(connect(file, "reader")) as connection:
        found = check_run(connection, run_id, **asked).findings
    return {e.name.removeprefix("expects: "): e[:2] for e in found if "expects" in e.name}


@pytest.mark.parametrize("every", [1, 5])
def test_a_violation_is_an_event_its_state_is_recorded_and_the_past_tells_the_same(
    project: Path, every: int
) -> None:
    file = project / "mcp_data" / "webots.db"
    drive(file, STATES, {"condition": "front_m > 0.1", **KEEPS}, every=every)
    with closing(connect(file, "reader")) as connection:
        live = connection.execute(
            "SELECT round(sim_time_s, 3), name, data FROM event WHERE kind = 'violation'"
        ).fetchall()
        whole = find_range(connection, Scope(run_id=1))
        found = find_events(connection, whole, EventOptions(kinds=("violation",))).events
        usual = find_events(connection, whole).verdicts.found
        score = score_run(connection, 1, "-count(violation)").value
        measures = {each.name: each for each in compare_runs(connection, [1]).measures}
    assert [name for _, name, _ in live] == ["keeps its distance"] * 2
    assert json.loads(live[0][2])["values"] == {"mode": "drive", "front_m": 0.05}
    assert [round(each.start_s, 3) for each in found] == [time_s for time_s, *_ in live]
    assert found[0].details == {"expected": "front_m > 0.1", "mode": "drive", "front_m": 0.05}
    assert usual["violation"] == 2
    assert usual["bridge_event"] == 2, "the controller's variables at each"
    assert score == -2
    assert measures["violation per min"].spread[0] is not None
    outcome, evidence = lines(file)["keeps its distance"]
    assert outcome == "fail"
    assert "2 times violated; worst front_m = 0.0" in evidence


def test_states_without_a_value_and_those_before_it_can_be_asked_are_not_judged(
    project: Path,
) -> None:
    file = project / "mcp_data" / "webots.db"
    still = [{"front_m": None, "x": 0.0, "y": 0.0, "mode": "drive"}] * 20
    expected = [
        {"condition": "front_m > 0.1", "name": "blind"},
        {"condition": "rate(x) < 1", "name": "slow"},
        {"condition": "displacement(0.2) > 1", "name": "far"},
        {"condition": "not missing(front_m)", "name": "seen"},
        {"condition": "x < 1", "during": "mode == 'dock'", "name": "docked"},
    ]
    drive(file, still, *expected)
    told = lines(file)
    assert told["blind"] == ("not applicable", "it was never asked; without a value in 20 rows")
    assert told["slow"][0] == "pass"
    assert told["far"][0] == "fail"
    assert told["far"][1].startswith("held 0 % of 0.112 s")  # not of the first 0.2 s
    assert told["seen"][0] == "fail"
    assert told["docked"][0] == "not applicable"
    with closing(connect(file, "reader")) as connection:
        names = connection.execute("SELECT name FROM event WHERE kind = 'violation'").fetchall()
    assert sorted(name for (name,) in names) == ["far", "seen"]  # live, the same


def test_each_row_lasts_to_the_next_one_and_the_last_as_long_as_usual(project: Path) -> None:
    file = project / "mcp_data" / "webots.db"
    drive(file, [{"front_m": 0.5, "mode": "drive"}] * 9 + [{"front_m": 0.05, "mode": "dock"}])
    drive(file, [{"front_m": 0.5, "mode": "drive"}])
    asked = ("front_m > 0.1", "front_m > 0 during mode == 'dock'")
    expected = [read_expectation(each) for each in asked]
    told = lines(file, expect=expected)
    outcome, evidence = told["front_m > 0.1"]
    assert (outcome, evidence.partition(";")[0]) == ("fail", "held 90 % of 0.16 s (10 rows)")
    assert told[expected[1].name] == ("pass", "held 100 % of 0.016 s (1 row)")
    assert lines(file, 2, expect=expected[:1])["front_m > 0.1"] == ("pass", "asked of its only row")


def test_what_was_expected_of_an_earlier_run_is_asked_of_it_and_of_no_other(project: Path) -> None:
    file = project / "mcp_data" / "webots.db"
    drive(file, STATES, {"condition": "front_m > 0.1", **KEEPS})
    drive(file, STATES, {"condition": "front_m > 0.01", "name": "new"})
    assert list(lines(file, 1)) == ["keeps its distance"]
    assert list(lines(file, 2)) == ["new"]
    found = read_expectation("front_m > 0.2 during mode == 'drive' and front_m > 0")
    assert list(lines(file, 2, expect=[found])) == ["new", found.name]
    with pytest.raises(UnknownSignalError, match=r"No signal 'frnt_m' is published.*front_m"):
        lines(file, 2, expect=[read_expectation("frnt_m > 1")])


def test_what_shall_be_reached_in_time_is_told_live_and_by_the_past_alike(project: Path) -> None:
    file = project / "mcp_data" / "webots.db"
    times = {"late": "0.1", "soon": "0.17", "open": "5"}
    expected = [
        {"condition": f"left_m < {'-' * (name == 'open')}0.05 within {within}", "name": name}
        for name, within in times.items()
    ]
    for _ in range(2):  # a run begins anew
        drive(file, [{"left_m": 1.0 - 0.1 * step} for step in range(12)], *expected)
    told = lines(file, 2)
    assert told["late"] == ("fail", "not within 0.1 s: after 0.16 s; worst left_m = 0.3")
    assert told["soon"] == ("pass", "after 0.16 s")
    assert told["open"] == ("pass", "after 0.176 s")
    short = read_expectation("left_m < -9 within 5")
    assert lines(file, 2, expect=[short])[short.name] == (
        "not applicable", "it lasted 0.176 s, not longer than 5 s"
    )  # fmt: skip
    never = read_expectation("left_m < -9 within .1")
    assert lines(file, 2, expect=[never])[never.name][1].startswith("not within 0.1 s: never")
    violated = read_expectation("x > 1 within 1").evaluator(lambda value: value)
    for _ in range(2):  # resets
        violated.forget()
        asked = [violated.holds({"x": x}, time_s) for time_s, x in enumerate((0, 0, 0, 2, 0))]
        assert asked == [False, False, True, True, False]
    with closing(connect(file, "reader")) as connection:
        live = "SELECT name, round(sim_time_s, 3) FROM event WHERE kind = 'violation'"
        assert connection.execute(live).fetchall() == [("late", 0.128)] * 2


@pytest.mark.parametrize("every", [1, 5])
def test_what_comes_too_late_is_no_success_however_rows_fall(project: Path, every: int) -> None:
    file = project / "mcp_data" / "webots.db"
    asked = {"x > 2 within 0.17": "fail", "x > 2 within 0.18": "pass", "x == 7 within 0.1": "pass",
             "not rate(y) < 5 within 0.1": "fail", "x > 2 for 9 within 0.1": "fail"}  # fmt: skip
    xs = [0, 0, 7, *[0] * 8, 3, 3, 3]  # 7 in one state alone, at 0.048 s; 3 from 0.192 s on
    expected = [{"condition": condition, "name": condition} for condition in asked]
    drive(file, [{"x": x, "y": 0} for x in xs], *expected[2:], every=every)
    drive(file, [{"x": x % 7, "y": 0} for x in xs], *expected[:2], every=every)
    told = {**lines(file, 1), **lines(file, 2)}
    assert {name: outcome for name, (outcome, _) in told.items()} == asked, told
    with closing(connect(file, "reader")) as connection:
        live = connection.execute("SELECT name FROM event WHERE kind = 'violation'").fetchall()
    assert {name for (name,) in live} == {name for name, told in asked.items() if told == "fail"}


def test_whether_it_was_reached_in_rows_that_were_deleted_is_not_said(project: Path) -> None:
    file = project / "mcp_data" / "webots.db"
    drive(file, [{"x": 3 * (1 < step < 40)} for step in range(50)], {"condition": "x > 2 within 1"})
    assert lines(file)["x > 2 within 1"][0] == "pass"
    with closing(connect(file, "writer")) as connection:
        connection.execute("DELETE FROM state WHERE sim_time_s < 0.7")
        connection.execute("UPDATE run SET purged_rows = 43")
        connection.commit()
    assert lines(file)["x > 2 within 1"][0] == "not looked at"


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"condition": "front_m >"}, "it ends too early"),
        ({"condition": "x > 1", "during": "1 > 0"}, "no signal is named"),
        ({"condition": "x > 1", "name": " "}, "the name of an expectation"),
        ({"condition": "x > 1 within 2", "during": "y"}, "counts from the begin of the run"),
        ({"condition": "x > 1", "name": "\ud800"}, "1 to 100 printable"),
    ],
)
def test_what_is_no_expectation_is_refused(wrong: dict[str, Any], why: str, tmp_path: Path) -> None:
    bridge = MCPBridge(InProcessSupervisor("rover"), database=tmp_path / "webots.db")
    with closing(bridge), pytest.raises((InvalidConditionError, InvalidInputError), match=why):
        bridge.expect(**wrong)


# -- the project's file ----------------------------------------------------------------------------

FILE = """\
# what we promised
[[expect]]
name = "keeps its distance"
condition = "front_m > 0.1"
during = "mode == 'drive'"

[[expect]]
condition = "battery_v > 11"
robot = "other"
"""


def test_the_file_of_a_project_is_compiled_and_asked_by_the_bridges_of_its_robots(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = project / "mcp_data" / "webots.db"
    (project / "webots-mcp.toml").write_text(FILE)
    assert main(["init", str(project), "--yes"]) == 0
    assert "2 expectations" in capsys.readouterr().out
    drive(file, STATES)
    with closing(connect(file, "writer")) as connection:
        assert connection.execute(
            "SELECT count(*) FROM event WHERE kind = 'violation'"
        ).fetchone() == (2,)
        watch = ProjectWatch(file.parent)
        watch.recompile_if_changed(connection)
        changed = FILE.replace("0.1", "0.01")
        (project / "webots-mcp.toml").write_text(changed)
        watch.recompile_if_changed(connection)
        assert lines(file)["keeps its distance"][0] == "pass"
        for text, line, why in (
            (FILE.replace("> 0.1", "> "), 4, "it ends too early"),
            (FILE.replace("robot =", "robto ="), 9, "unknown key 'robto'"),
            (FILE.replace('"other"', "3"), 9, "robot must be a text, not 3"),
            (FILE.replace('"mode', '"((mode'), 5, "never closed"),
        ):
            (project / "webots-mcp.toml").write_text(text)
            with pytest.raises(InvalidInputError, match=f"toml, line {line}: .*{why}"):
                read_project(project / "webots-mcp.toml")
        watch.recompile_if_changed(connection)  # changes nothing, and says so
        assert "toml, line 5" in capsys.readouterr().err
        assert list(lines(file)) == ["keeps its distance"]
    where = ["--data-dir", str(file.parent)]
    assert main(["check", *where]) == 2
    assert "toml, line 5" in capsys.readouterr().err
    (project / "webots-mcp.toml").write_text("[[expect]\n")
    assert main(["check", *where]) == 2
    assert "at line 1" in capsys.readouterr().err
    (project / "webots-mcp.toml").unlink()
    main(["check", *where])
    assert lines(file) == {}


# -- the command, the tool and the assertion -------------------------------------------------------


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[tuple[Path, Recorder]]:
    file = tmp_path / "webots.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        recorder = start_run(connection)
        for step in range(300):
            recorder.publish(step / 10, {"pose": [step / 100, 0.0], "commanded_m_s": 0.1})
        yield file, recorder


@pytest.mark.slow
def test_the_command_ends_with_0_1_or_2_and_writes_what_continuous_integration_reads(
    recorded: tuple[Path, Recorder], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, recorder = recorded
    where = ["--database", str(file), "--junit", str(tmp_path / "check.xml")]
    recorder.insert("log", **recorder.at(9.0), level="warning", source="controller",
                    message="silent in a.py:1\n  File a.py, line 1")  # fmt: skip
    assert main(["check", "1", *where]) == 0
    assert "1 warning; first: silent in a.py:1 " in capsys.readouterr().out
    assert main(["check", *where, "--expect", "pose.0 < 2"]) == 1
    out = capsys.readouterr().out
    assert "webots-mcp events --where 'not (pose.0 < 2)' --run 1" in out
    quoted = """pose.0 < 2 or pose.1 == 'a"b' or pose.1 == "it's\""""
    assert main(["check", "1", "--expect", quoted, "--database", str(file)]) == 1
    more = re.search("webots-mcp events --where.*", capsys.readouterr().out)
    assert more and main([*shlex.split(more[0])[1:], "--database", str(file)]) == 0
    suite = ElementTree.parse(tmp_path / "check.xml").getroot()
    assert suite.attrib["failures"] == "1"
    cases = {each.attrib["name"]: [part.tag for part in each] for each in suite}
    assert cases["expects: pose.0 < 2"] == ["failure"]
    assert cases["logs no errors"] == ["system-out"]
    assert cases["moves when commanded"] == []
    assert main(["check", "7", *where]) == 2
    assert main(["check", "1", "--expect", "pose.0 <", *where]) == 2
    capsys.readouterr()
    assert main(["check", "--junit", str(tmp_path / "no" / "x.xml"), *where[:2]]) == 2
    assert capsys.readouterr().out == ""  # the file comes first


@pytest.mark.anyio
async def test_the_tool_answers_shortly_and_refuses_what_is_no_condition(
    recorded: tuple[Path, Recorder],
) -> None:
    file, _ = recorded
    async with Client(create_server(file, file.parent)) as client:
        asked = {"expect": ["pose.0 < 2", "pose.1 < 1"]}
        answer = await client.call_tool("webots_check_run", asked)
        assert answer.structured_content is not None
        told = answer.structured_content
        assert told["outcome"] == "fail"
        assert told["checks"]["rows"][0][:2] == ["expects: pose.0 < 2", "fail"]
        assert "expects: pose.1 < 1" in told["passed"]
        assert len(json.dumps(told)) < 5000
        many = {"expect": [f"pose.0 < 2 during pose.0 > -{each}{'0' * 80}" for each in range(20)]}
        answer = await client.call_tool("webots_check_run", many)
        assert answer.structured_content is not None
        told = answer.structured_content
        shown = str(told["checks"]["rows"]).count("'fail'")
        assert told["notes"][-1].startswith(f"not shown: {20 - shown} fail, ")
        assert len(json.dumps(told)) < 7500
        wrong = await client.call_tool("webots_check_run", {"expect": ["pose.0 <"]})
        assert wrong.is_error


def test_a_test_asserts_that_a_run_is_well(recorded: tuple[Path, Recorder]) -> None:
    file, recorder = recorded
    recording = RobotRecording(file)
    recording.assert_well("pose.0 < 5")
    with pytest.raises(AssertionError, match=r"expects: pose.0 < 2: held 6\d"):
        recording.assert_well("pose.0 < 2")
    recorder.insert("log", **recorder.at(9.0), level="error", source="controller", message="boom")
    with pytest.raises(AssertionError, match="logs no errors: 1 error; first: boom"):
        recording.assert_well()
    recording.assert_well(allow=["logs no errors"])
    with pytest.raises(InvalidInputError, match="no check 'logs'; there is"):
        recording.assert_well(allow=["logs"])
