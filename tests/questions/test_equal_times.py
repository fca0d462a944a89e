"""Every question that only reads, of recordings whose clock does not do what one expects."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final, cast

import anyio
import numpy as np
import pytest

from tests.recordings.rows import Recorded
from webots_mcp.analysis.path_length import hidden_motion
from webots_mcp.analysis.summary import flat_since
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.errors import WebotsMCPError
from webots_mcp.plotting.signal_plot import compose_signals
from webots_mcp.plotting.trajectory import compose_trajectory
from webots_mcp.plugins.report.make_report import make_report
from webots_mcp.questions import all_questions
from webots_mcp.questions.declaration import Caller, Question
from webots_mcp.store.export import FOR_VIEWERS, FORMATS, export, export_for_viewers
from webots_mcp.store.reading.ranges import Scope, find_range
from webots_mcp.store.recording import RecordingAccess

_STEP_S: Final = 0.016
_ROWS: Final = 1500
_EVEN: Final = [n * _STEP_S for n in range(_ROWS)]
CLOCKS: Final[dict[str, Sequence[float]]] = {
    "two at each time": [n // 2 * _STEP_S for n in range(_ROWS)],
    "three at each time": [n // 3 * _STEP_S for n in range(_ROWS)],
    "all at one time": [4.0] * _ROWS,
    "one row": [4.0],
    "two rows": [4.0, 4.0 + _STEP_S],
    "two rows at one time": [4.0, 4.0],
    "no row": [],
    "stands still for a while": [*_EVEN[:500], *[_EVEN[500]] * 500, *_EVEN[501:1001]],
    "goes back": [*_EVEN[:800], *_EVEN[300:1000]],
}
# What a question has to be told; a new one that must be told something else is added here.
_TOLD: Final[dict[str, Any]] = {
    "signals": ["*"],
    "sql": "SELECT count(*), min(sim_time_s) FROM state",
    "path": "ROVER",
    "command_id": 1,
}
READING: Final = [each for each in all_questions() if each.effect.reads]


async def _report(_done: float, _of: float | None, _text: str) -> None:
    """Nobody is shown how long it takes."""


_CALLER: Final = Caller("cli", _report, cast("Any", None))  # what only reads starts nothing


@pytest.fixture(scope="module", params=CLOCKS)
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that goes to and fro, and stands at the end."""
    made = tmp_path_factory.mktemp("clock")
    recorded = Recorded(made / "webots.db")
    robot = recorded.robot(now=1_700_000_000.0)
    times = CLOCKS[str(request.param)]
    with recorded.connection:
        for n, sim_time_s in enumerate(times):
            at = min(n, 900) * _STEP_S
            pose = [math.sin(at), 0.3 * at + 0.002 * math.sin(700 * n), 0.0]
            data = {"pose": {"x": pose[0], "y": pose[1], "yaw": at % 6}, "front_m": 1 + pose[0]}
            wall_time_s = 1_700_000_000.0 + n * _STEP_S
            robot.state(
                sim_time_s, {**data, "mode": "go" if n % 400 < 300 else "wait"}, at=wall_time_s
            )
        if times:
            robot.log(times[-1], "it ends", "warning")
        robot.end_run("controller_exit")
    recorded.close()
    return made


@pytest.mark.slow
@pytest.mark.parametrize("asked", READING, ids=lambda each: each.name)
def test_a_question_is_answered_or_refused_in_words(folder: Path, asked: Question) -> None:
    recording = RecordingAccess(folder / "webots.db", folder, read_only=True)
    fields = asked.arguments.model_fields
    needed = {name: _TOLD[name] for name, field in fields.items() if field.is_required()}
    arguments = asked.arguments.model_validate(needed).model_dump()
    try:
        reply = anyio.run(asked.ask, recording, arguments, _CALLER)
    except WebotsMCPError as error:
        assert str(error)
        return
    assert "nan" not in str(reply.shown).lower()


@pytest.mark.parametrize("compose", [compose_signals, compose_trajectory])
def test_a_plot_is_drawn_or_refused_in_words(folder: Path, compose: Any) -> None:
    names = (["*"],) if compose is compose_signals else ()
    with closing(connect(folder / "webots.db", "reader")) as connection:
        try:
            assert compose(connection, [find_range(connection, Scope(run_id=1))], *names)
        except WebotsMCPError as error:
            assert str(error)


@pytest.mark.parametrize("calls_at_a_time", [1, 2, 3])
def test_a_robot_that_stands_went_nowhere_however_often_it_publishes(calls_at_a_time: int) -> None:
    noise = np.random.default_rng(1).normal(0, 0.002, (2, 6000))
    times = (np.arange(6000) // calls_at_a_time * _STEP_S).astype(np.float64)
    ends = [0, 6000]
    x, y = noise
    slow, least_m, most_m = hidden_motion(times, x, y, ends)
    assert (slow, least_m) == ([0], 0.0)
    _, crept_m, most_m = hidden_motion(times, x + 0.05 * times, y, ends)
    assert 0.6 * 0.05 * times[-1] < crept_m < most_m < 1.5 * 0.05 * times[-1]


def test_in_no_time_nothing_moves() -> None:
    assert hidden_motion(np.zeros(900), np.zeros(900), np.zeros(900), [0, 900]) == ([], 0.0, 0.0)


def test_nothing_rests_in_no_time() -> None:
    values = np.concatenate((np.arange(20.0), np.full(5, 19.0)))
    assert flat_since(np.full(25, 4.0), values) is None
    assert flat_since(np.arange(25.0), values) == 19.0


def test_a_report_is_written(folder: Path) -> None:
    with closing(connect(folder / "webots.db", "reader")) as connection:
        assert make_report(connection, [1], folder).html


@pytest.mark.parametrize("form", [*FORMATS, *FOR_VIEWERS])
def test_every_row_is_exported(folder: Path, form: str) -> None:
    with closing(connect(folder / "webots.db", "reader")) as connection:
        (count,) = connection.execute("SELECT count(*) FROM state").fetchone()
        try:
            whole = find_range(connection, Scope(run_id=1))
            if form in FORMATS:
                assert export(connection, whole, form, io.BytesIO()) == count
            else:
                export_for_viewers(connection, folder, whole, form, folder / f"made.{form}")
        except WebotsMCPError as error:
            assert count == 0 or "not installed" in str(error), error


def test_a_check_ends_with_a_verdict(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["check", "1", "--json", "--data-dir", str(folder)])
    said = capsys.readouterr()
    assert "keeps pace" in said.out or "no state row yet" in said.err, said
