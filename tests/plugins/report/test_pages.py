"""What a report says, and what it never does."""

from __future__ import annotations

import math
import re
import sqlite3
from base64 import b64decode
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from tests.plugins.report.conftest import Shown
from tests.recordings.rows import Recorded
from webots_mcp.analysis.summary import Spread
from webots_mcp.errors import InvalidInputError, UnknownRunError, UnknownSignalError
from webots_mcp.judging.checks.check import Finding
from webots_mcp.judging.checks.check_run import CheckedRun
from webots_mcp.judging.comparison import compare_runs
from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.run_measures import Measure
from webots_mcp.judging.verdicts import Outcome
from webots_mcp.plugins.report.chapter_opening import most_important
from webots_mcp.plugins.report.make_report import Report, make_report
from webots_mcp.plugins.report.run_comparison import verdict_of, with_repeats
from webots_mcp.plugins.report.words import cut, describe_event, length, number

EVIL = "</script><script>window.harmed = true</script><img src=x onerror=alert(1)>"


@pytest.mark.slow
def test_it_tells_what_ran_as_it_was_recorded(page: Shown, recording: sqlite3.Connection) -> None:
    (sha256, versions) = recording.execute(
        "SELECT controller_sha256, json_extract(versions, '$.python') FROM session WHERE id = 1"
    ).fetchone()
    assert "Run 1 of rover" in page.text
    assert "Run 2 of rover" in page.text
    assert sha256 is None or sha256 in page.text
    assert versions in page.text


def test_durations_and_cut_texts_are_told_in_words() -> None:
    told = [length(duration_s) for duration_s in (119.5, 120.0, 7199.0, 7500.0)]
    assert told == ["120 s", "2 min 0 s", "119 min 59 s", "2 h 5 min"]
    assert cut("abcde", 5) == "abcde"
    assert cut("abcdef", 5) == "abcde … (6 characters)"


def test_it_tells_events_with_the_seconds_around_them(page: Shown) -> None:
    moments = page.text[page.text.index("Most important moments") :]
    moments = moments[: moments.index("Checks")]
    assert re.search(r"\w+ at [\d.]+ s", moments)
    assert "of the timeline around it" in moments
    assert "grasp(): failed" in page.text
    assert "the gripper is not mounted" in page.text


def test_it_begins_with_what_happened_then_moments_then_checks_then_details(page: Shown) -> None:
    chapter = page.text[page.text.rindex("Run 1 of rover") :]
    places = [
        chapter.index(each)
        for each in ("rover ran for", "Most important moments", "Checks", "Details", "Events (")
    ]
    assert places == sorted(places)
    assert re.search(r"(Failed|Passed|Not judged)[\w ]* rover ran for [\w. ]+ and ", chapter)


def event(kind: str, start_s: float, duration_s: float = 0.0) -> Event:
    return Event(kind, 1, start_s, start_s + duration_s, 0.0)


def test_each_kind_has_a_moment_before_any_has_a_second_and_falls_come_first() -> None:
    jumps = [event("jump", at_s) for at_s in (1.0, 2.0, 3.0)]
    stuck = [event("stuck", 4.0, 3.0), event("stuck", 20.0, 9.0)]
    fall = event("fall", 30.0)
    assert most_important([*jumps, *stuck, fall]) == [jumps[0], stuck[1], fall]
    assert most_important([*stuck, fall], most=2) == [stuck[1], fall]
    assert most_important(stuck) == stuck


def checked(run_id: int, outcome: Outcome) -> CheckedRun:
    return CheckedRun(run_id, "rover", (Finding(outcome, "its evidence", name="keeps pace"),))


@pytest.mark.parametrize(
    ("first", "second", "words", "said"),
    [
        ("fail", "pass", "better", "Run 2 did better: its checks passed, those of run 1 failed"),
        ("pass", "warn", "worse", "Run 1 did better"),
        ("pass", "pass", "cannot tell", "Neither run did better by its checks: both passed."),
        ("pass", "not judged", "cannot tell", "Cannot tell which run did better"),
    ],
)
def test_two_runs_are_compared_by_their_checks_first(
    first: Outcome, second: Outcome, words: str, said: str
) -> None:
    verdict = verdict_of([checked(1, first), checked(2, second)], ())
    assert verdict.words == words
    assert said in verdict.text


def measure(
    name: str, first: float, second: float, different: bool | None, by: tuple[float, float] | None
) -> Measure:
    spread: list[Spread | None] = [Spread(each, each, each) for each in (first, second)]
    return Measure(name, spread, [None, different], [None, None], [None, by])


def test_repeats_decide_which_run_did_better_with_measure_and_interval() -> None:
    both = [checked(1, "pass"), checked(2, "pass")]
    faster = verdict_of(both, [measure("time_to_goal_s", 14.0, 11.0, True, (-4.0, -2.0))])
    assert faster.words == "better"
    assert "Run 2 did better: time_to_goal_s 11 instead of 14" in faster.text
    assert "the difference is -4 to -2 (90 % interval of means)" in faster.text
    slower = verdict_of(both, [measure("time_to_goal_s", 11.0, 14.0, True, (2.0, 4.0))])
    assert slower.words == "worse"
    alike = verdict_of(both, [measure("distance_m", 5.0, 5.1, False, (-0.1, 0.3))])
    assert alike.words == "not different"
    open_question = verdict_of(both, [measure("distance_m", 5.0, 5.1, None, (-1.0, 3.0))])
    assert open_question.words == "cannot tell"
    assert "distance_m 5.1 instead of 5 (+2 %), the difference is -1 to +3" in open_question.text


def test_runs_of_equal_code_and_parameters_count_as_repeats(recorded: Recorded) -> None:
    robot = recorded.robot()
    run_ids: list[int] = []
    for speed in (3, 8, 3, 8, 8):
        run_ids.append(robot.begin_run("reset"))
        robot.state(0.0, {"x": 0.0})
        robot.state(10.0, {"x": 1.0})
        recorded.connection.execute(
            "INSERT INTO parameter_value "
            "(run_id, name, sim_time_s, wall_time_s, value, is_default, set_by) "
            "VALUES (?, 'speed', 0, 0, ?, 0, 'code')",
            (robot.run_id, speed),
        )
    one, other, third, fourth, fifth = run_ids
    assert with_repeats(recorded.connection, [one, other]) == [one, third, other, fourth, fifth]
    assert with_repeats(recorded.connection, [one, third]) == [one, third], "they are repeats"


def test_a_jump_of_several_items_of_an_array_is_described_by_what_they_share() -> None:
    before, after = {"before": 1.0, "after": 0.5}, {"before": 1.0}
    one = Event("jump", 1, 2.0, 3.0, 0.0, "lidar.3", before | {"back": 1.0})
    assert describe_event(one) == "lidar.3: 1 → 0.5, then back to 1"
    several = Event("jump", 1, 2.0, 3.0, 0.0, "lidar.*", after)
    assert describe_event(several) == "lidar.*: before 1"


def test_a_crash_and_events_of_failed_checks_come_before_longer_ones() -> None:
    stuck, slip, crash = event("stuck", 4.0, 30.0), event("slip", 3.0, 1.0), event("crash", 40.0)
    failed = CheckedRun(1, "rover", (Finding("fail", "slipped", 3.0, name="wheels grip"),))
    assert most_important([stuck, slip, crash], failed, 2) == [slip, crash]
    assert most_important([stuck, slip], failed, 1) == [slip]
    assert most_important([stuck, slip], None, 1) == [stuck]


def test_a_report_of_a_crash_shows_the_last_seconds(recorded: Recorded, tmp_path: Path) -> None:
    robot = recorded.robot()
    for step in range(50):
        robot.state(step * 0.1, {"pose": {"x": step * 0.1, "y": 0.0}, "elapsed_s": step * 0.1})
    robot.log(4.8, "ZeroDivisionError: division by zero", "error")
    robot.end_run("crashed")
    report = make_report(recorded.connection, [robot.run_id], tmp_path)
    text = Shown(report.html).text
    assert "its controller crashed. 1 error; first: ZeroDivisionError" in text
    assert "Crash at 4.900 s" in text
    assert 'data-figure="moment 1 1"' in report.html.decode()
    drawn = report.html.decode().split('data-figure="signals 1"')[1].split("</script>")[0]
    assert "pose.x" in drawn
    assert "elapsed_s" not in drawn, "a clock over time shows nothing"


def test_a_moment_shows_what_the_controllers_variables_held(
    recorded: Recorded, tmp_path: Path
) -> None:
    robot = recorded.robot()
    for step in range(50):
        robot.state(step * 0.1, {"pose": {"x": step * 0.1, "y": 0.0}})
    robot.log(4.8, "ZeroDivisionError: division by zero", "error")
    frame = {"at": "nav.py:7", "function": "turn", "source": ["left / by"], "variables": {"by": 0}}
    robot.event(4.8, "inspection", "division by zero", {"cause": "error", "frames": [frame, 3, {}]})
    robot.end_run("crashed")
    text = Shown(make_report(recorded.connection, [robot.run_id], tmp_path).html).text
    assert "Variables of the controller at 4.800 s (error: division by zero)" in text
    assert "nav.py:7, turn()" in text and "left / by" in text
    assert "Inspection at" not in text, "it belongs to its moment, and is none itself"


def test_a_fall_is_shown_with_the_signals_it_is_judged_by(
    recorded: Recorded, tmp_path: Path
) -> None:
    robot = recorded.robot()
    for step in range(600):
        time_s = step * 0.05
        roll = 1.57 if time_s > 15 else 0.0
        state = {"pose": {"x": min(time_s, 15) * 0.2, "y": 0.0}, "roll": roll, "pitch": 0.0}
        robot.state(time_s, state | {"noise_v": step % 7})
    robot.end_run("finished")
    html = make_report(recorded.connection, [robot.run_id], tmp_path).html
    text = Shown(html).text
    assert re.search(r"Failed rover ran for 30 s and its controller finished\. Fell once", text)
    assert "Fell: tilted by 90° (right), stayed down" in text
    figure = html.decode().split("Fall at ")[1].split("</script>")[0]
    assert '"name":"roll"' in figure
    assert '"name":"pose.x"' not in figure


def test_what_could_not_be_judged_is_one_paragraph_with_the_call_that_declares_meanings(
    recorded: Recorded, tmp_path: Path
) -> None:
    robot = recorded.robot()
    for step in range(50):
        robot.state(step * 0.1, {"qz": float(step % 5)})
    text = Shown(make_report(recorded.connection, [robot.run_id], tmp_path).html).text
    (line,) = re.findall(r"\d+ checks could not be judged: .*? Details", text)
    assert "To declare what a signal means: webots_describe_signals(signals=['qz']" in line


def test_a_report_names_a_newer_start_that_recorded_no_run(
    recorded: Recorded, tmp_path: Path
) -> None:
    robot = recorded.robot()
    robot.state(1.0, {"x": 1.0})
    recorded.connection.execute(
        "INSERT INTO session (robot_id, uuid, pid, host, instance, started_wall_time_s, "
        "last_error, supervisor, last_seen_wall_time_s) "
        "SELECT robot_id, 'newer', pid, host, instance, 2e9, 'ImportError: numpy', "
        "supervisor, 2e9 FROM session"
    )
    text = make_report(recorded.connection, [robot.run_id], tmp_path).html.decode()
    assert "A newer start of this controller" in text
    assert "recorded no run (ImportError: numpy)" in text


def test_it_tells_for_how_long_each_mode_was_there(page: Shown) -> None:
    modes = page.text[page.text.index("Time per value of mode") :]
    assert re.match(r"Time per value of mode cruise [\d.]+ s, [\d.]+ % ", modes)


def test_it_compares_two_runs_as_compare_runs_does(
    page: Shown, recording: sqlite3.Connection
) -> None:
    found = compare_runs(recording, [1, 2])
    (distance,) = (each for each in found.measures if each.name == "distance_m")
    one, other = distance.spread
    assert one is not None
    assert other is not None
    assert f"distance_m {one.median:.4g} {other.median:.4g}" in page.text
    assert all(note in page.text for note in found.notes)


def test_its_pictures_are_inside(page: Shown, recording: sqlite3.Connection) -> None:
    (count,) = recording.execute("SELECT count(*) FROM image").fetchone()
    sources = [value for tag, name, value in page.attributes if (tag, name) == ("img", "src")]
    assert len(sources) >= count > 0
    assert all(source.startswith("data:image/") for source in sources)


def test_it_refers_to_nothing_outside(both: Report, page: Shown) -> None:
    links = [
        value
        for tag, name, value in page.attributes
        if name in ("src", "href", "srcset", "action", "data", "poster") and tag != "a"
    ]
    assert all(link.startswith("data:") for link in links)
    anchors = [value for tag, name, value in page.attributes if (tag, name) == ("a", "href")]
    assert anchors
    assert all(anchor.startswith("#") for anchor in anchors)
    assert not re.search(r"url\(|@import", " ".join(page.styles))
    (policy,) = (value for _, _, value in page.attributes if value.startswith("default-src"))
    assert "http" not in policy


def test_every_link_leads_to_a_place_in_the_page(page: Shown) -> None:
    places = {value for _, name, value in page.attributes if name == "id"}
    anchors = {value[1:] for tag, name, value in page.attributes if (tag, name) == ("a", "href")}
    assert anchors <= places


def test_it_says_how_large_it_is(both: Report, page: Shown) -> None:
    assert f"It takes {len(both.html) / 1e6:.2f} MB of at most 10 MB" in page.text


def test_what_was_recorded_is_shown_and_never_run(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot(f"rover {EVIL}", controller=f"/c/{EVIL}.py")
    for step in range(50):
        mode = EVIL if step > 25 else "drive"
        robot.state(step * 0.1, {EVIL: step, "mode": mode, "pose": [step * 0.1, 0.0, 0.0]})
    robot.log(1.0, EVIL, "error")
    robot.event(2.0, "noticed_it", EVIL, {"why": EVIL})
    report = make_report(recorded.connection, [robot.run_id], tmp_path)
    recorded.close()
    shown = Shown(report.html)
    assert shown.text.count("window.harmed") >= 4
    assert not [each for each in shown.attributes if each[1].startswith("on")]
    assert b"<script>window" not in report.html
    assert b"<img src=x" not in report.html


def test_it_stays_as_small_as_was_asked_and_tells_what_is_not_in_it(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    for step in range(120):
        robot.state(step * 0.1, {f"s{i}": (step * (i + 1)) % 7 for i in range(30)})
        robot.log(step * 0.1, f"line {step} " + "<" * 3_000)
    report = make_report(recorded.connection, [robot.run_id], tmp_path, max_mb=2)
    recorded.close()
    assert len(report.html) <= 2_000_000
    assert any(re.match(r"\d+ of the log lines of run 1", each) for each in report.left_out)
    assert any("of 30 numeric signals" in each for each in report.left_out)
    text = Shown(report.html).text
    assert all(each in text for each in report.left_out)
    assert "line 119" in text, "the newest lines stay"


def _hunter_and_runner(folder: Path, beside: Mapping[str, str]) -> tuple[Recorded, list[int]]:
    """A run of each, with a number of its own and what both publish beside it."""
    recorded = Recorded(folder / "webots.db")
    run_ids: list[int] = []
    for name in ("hunter", "runner"):
        robot = recorded.robot(name)
        run_ids.append(robot.run_id)
        for step in range(20):
            robot.state(step * 0.1, {f"{name}_m": step, **beside})
    return recorded, run_ids


def test_runs_of_two_robots_that_have_nothing_in_common_are_told_side_by_side(
    tmp_path: Path,
) -> None:
    recorded, run_ids = _hunter_and_runner(tmp_path, {})
    report = make_report(recorded.connection, run_ids, tmp_path, names=["hunter_m"])
    recorded.close()
    assert "the signals of both runs: none that was asked for is in both" in report.left_out
    assert "Run 1 of hunter and Run 2 of runner" in report.title


def test_runs_that_share_only_texts_are_told_to_share_no_numbers(tmp_path: Path) -> None:
    recorded, run_ids = _hunter_and_runner(tmp_path, {"mode": "a"})
    report = make_report(recorded.connection, run_ids, tmp_path)
    recorded.close()
    assert "the signals of both runs: they share no numeric signals" in report.left_out


def test_of_a_run_without_rows_it_tells_what_there_is(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    robot.log(0.0, "ModuleNotFoundError: No module named 'cv2'", "error")
    report = make_report(recorded.connection, [robot.run_id], tmp_path)
    recorded.close()
    text = Shown(report.html).text
    assert "No module named 'cv2'" in text
    assert "no state row" in text or "nothing" in text
    assert "figures" not in report.holds


def test_pictures_whose_files_are_gone_are_counted(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    robot.state(0.0, {"x": 1})
    robot.state(1.0, {"x": 2})
    robot.image(0.5, "camera/gone.png")
    robot.image(0.6, "../outside.png")
    report = make_report(recorded.connection, [robot.run_id], tmp_path)
    recorded.close()
    assert "2 of the pictures of run 1 (2 files cannot be read)" in report.left_out


@pytest.mark.slow
def test_pictures_are_scaled_down_and_thinned_evenly_where_they_have_no_room(
    tmp_path: Path,
) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    for step in range(20):
        robot.state(step, {"x": step})
        file = tmp_path / f"{step}.png"
        Image.effect_noise((900, 700), 80).save(file)
        robot.image(step, file.name)
    report = make_report(recorded.connection, [robot.run_id], tmp_path, max_mb=2)
    recorded.close()
    shown = Shown(report.html)
    sources = [value for tag, name, value in shown.attributes if (tag, name) == ("img", "src")]
    assert 0 < len(sources) == report.holds["pictures"] < 20
    assert len(report.html) <= 2_000_000
    assert f"{20 - len(sources)} of the pictures of run 1" in report.left_out
    sizes = {Image.open(BytesIO(b64decode(each.partition(",")[2]))).size for each in sources}
    assert sizes == {(640, 498)}


@pytest.mark.parametrize(
    ("run_ids", "options", "error", "says"),
    [
        ([], {}, InvalidInputError, "one run or two, not 0"),
        ([1, 2, 3], {}, InvalidInputError, "one run or two, not 3"),
        ([1, 1], {}, InvalidInputError, "named twice"),
        ([7], {}, UnknownRunError, "No run 7 is"),
        ([1], {"max_mb": 1}, InvalidInputError, "from 2 to 100"),
        ([1], {"max_mb": float("nan")}, InvalidInputError, "from 2 to 100"),
        ([1], {"names": ["nosuch"]}, UnknownSignalError, "nosuch"),
    ],
)
def test_what_cannot_be_reported_is_refused(
    recording: sqlite3.Connection,
    tmp_path: Path,
    run_ids: list[int],
    options: dict[str, Any],
    error: type[Exception],
    says: str,
) -> None:
    with pytest.raises(error, match=says):
        make_report(recording, run_ids, tmp_path, **options)


@pytest.mark.parametrize(
    ("value", "span", "told"),
    [(-4.857e-17, 0.64, "0"), (-4.857e-17, 0.0, "-4.857e-17"), (1e308, math.inf, "1e+308")],
)
def test_what_is_nothing_beside_the_span_of_its_signal_is_0(
    value: float, span: float, told: str
) -> None:
    assert number(value, span) == told


def test_a_number_that_cancelled_itself_out_is_told_as_0(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path / "webots.db")
    robot = recorded.robot()
    for step in range(50):
        robot.state(step * 0.1, {"x": step * 0.013 or -4.857e-17})
    text = Shown(make_report(recorded.connection, [robot.run_id], tmp_path).html).text
    recorded.close()
    assert "e-17" not in text
