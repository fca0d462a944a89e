"""A tape goes where its run goes, and goes with it."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from tests.rerun.taping import WORLD, data_dir_of, record, recorded, rerun_of, tapes
from tests.rerun.taping import project as make_project
from tests.rerun.test_repeating import RESETS
from webots_mcp.cli import main
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.store.purge import prune
from webots_mcp.store.retention_limits import Limit, Retention
from webots_mcp.testing import RecordedSimulation, assert_same_commands


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("taped")
    recorded(folder, duration_s=2.0)
    return folder


def tape_files(data_dir: Path) -> list[bytes]:
    return [file.read_bytes() for file in (data_dir / "tapes").rglob("*.tape")]


def test_a_bundle_takes_the_tape_along(project: Path, tmp_path: Path) -> None:
    bundle, other = tmp_path / "run.zip", tmp_path / "other"
    main(["export", "--run", "1", "-o", str(bundle), "--data-dir", str(data_dir_of(project))])
    main(["import", str(bundle), "--data-dir", str(other)])
    assert tape_files(other) == tape_files(data_dir_of(project))
    assert len(tape_files(other)) == 1


def test_an_import_takes_the_tape_along_once(project: Path, tmp_path: Path) -> None:
    for _ in range(2):
        source = data_dir_of(project) / DATABASE_NAME
        main(["import", str(source), "--data-dir", str(tmp_path)])
    assert tape_files(tmp_path) == tape_files(data_dir_of(project))


@pytest.mark.slow
def test_code_that_came_with_an_import_runs_only_for_a_person_who_trusts_it(
    project: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle, other = tmp_path / "run.zip", tmp_path / "other"
    main(["export", "--run", "1", "-o", str(bundle), "--data-dir", str(data_dir_of(project))])
    main(["import", str(bundle), "--data-dir", str(other)])
    assert main(["rerun", "1", "--data-dir", str(other)]) != 0
    assert "was imported" in capsys.readouterr().err
    assert main(["rerun", "1", "--trust", "--data-dir", str(other)]) in (0, None)
    assert "unchanged code commands the same" in " ".join(capsys.readouterr().out.split())
    again = tmp_path / "again.zip"
    main(["export", "--run", "1", "-o", str(again), "--data-dir", str(other)])
    controller = project / "controllers" / "rover" / "rover.py"
    assert assert_same_commands(again, controller).rounds == 126


def test_a_pool_takes_the_tape_along_with_pictures(project: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pool, other = str(tmp_path / "pool"), tmp_path / "other"
    assert main(["ship", "--to", pool, "--pictures", "--data-dir", str(data_dir_of(project))]) == 0
    assert main(["fetch", "--from", pool, "--robot", "rover", "--data-dir", str(other)]) in (
        0,
        None,
    )
    assert tape_files(other) == tape_files(data_dir_of(project))


@pytest.mark.slow
def test_a_tape_is_deleted_with_the_last_run_of_its_session(tmp_path: Path) -> None:
    recorded(tmp_path, duration_s=1.0)
    data_dir = data_dir_of(tmp_path)
    (first,) = tape_files(data_dir)
    record(tmp_path / "worlds" / WORLD.name, data_dir, 2.0)
    assert len(tape_files(data_dir)) == 2
    with closing(connect(data_dir / DATABASE_NAME, "writer")) as connection:
        few = Limit(rows=20)
        purged = prune(connection, data_dir, Retention(state=few, chunk=few, outlive=1.0))
        assert [row[0] for row in connection.execute("SELECT id FROM run")] == [2]
    assert len(tape_files(data_dir)) == 1
    assert first not in tape_files(data_dir)
    assert not purged.problems


@pytest.mark.slow
def test_commands_and_parameters_of_the_old_run_are_given_again(tmp_path: Path) -> None:
    code = """\
import json
from math import inf

from controller import Robot

from webots_mcp import MCPBridge

robot = Robot()
bridge = MCPBridge(robot)
step_ms = int(robot.getBasicTimeStep())
motors = [robot.getDevice(f"{side} wheel motor") for side in ("left", "right")]
speed = bridge.parameter("speed", 2.0, low=0.0, high=9.0)
extra = [0.0]
bridge.register_command("faster", lambda command: extra.__setitem__(0, command["by"]))
bridge.expect("speed < 100")
bridge.describe("speed", quantity="wheel speed", role="commanded")
for motor in motors:
    motor.setPosition(inf)
while robot.step(step_ms) != -1:
    bridge.publish({"speed": speed.value})
    bridge.get_command()
    for motor in motors:
        motor.setVelocity(speed.value + extra[0])
"""
    controller = make_project(tmp_path, code)
    with RecordedSimulation(
        tmp_path / "worlds" / WORLD.name,
        data_dir=data_dir_of(tmp_path),
        environment={"WEBOTS_MCP_TAPE": "1"},
        parameters={"speed": 3.0},
    ) as simulation:
        simulation.run_for(1.0)  # type: ignore[attr-defined]
        simulation.recording.send("faster", by=1.5)  # type: ignore[attr-defined]
        simulation.run_for(1.0)  # type: ignore[attr-defined]
        simulation.recording.send("set_parameters", values={"speed": 5.0})  # type: ignore[attr-defined]
        simulation.run_for(1.0)  # type: ignore[attr-defined]
    answer = rerun_of(tmp_path, controller)
    assert answer.outcome == "equal", answer.text
    said = {
        value[0][0]
        for tape in tapes(tmp_path)
        for each in tape.rounds()
        for number, value in zip(each.events[::2], each.events[1::2], strict=True)
        if number and tape.calls[number].name == "setVelocity"
    }
    assert said == {3.0, 4.5, 6.5}
    controller.write_text(code.replace("+ extra[0]", "+ 2 * extra[0]"), "utf-8")
    assert "setVelocity 6.0 instead of 4.5" in rerun_of(tmp_path, controller).text


@pytest.mark.slow
def test_an_exported_later_run_of_a_session_is_still_that_run(tmp_path: Path) -> None:
    controller = make_project(tmp_path, RESETS)
    record(tmp_path / "worlds" / "arena.wbt", data_dir_of(tmp_path), 4.0)
    bundle = tmp_path / "second.zip"
    where = ["--data-dir", str(data_dir_of(tmp_path))]
    main(["export", "--run", "2", "-o", str(bundle), *where])
    whole = rerun_of(tmp_path, controller)
    assert whole.outcome == "equal", whole.text
    controller.write_text(RESETS.replace("+ x_m % 1)", "+ x_m % 1 + (resets == 1))"), "utf-8")
    with pytest.raises(AssertionError, match="setVelocity"):
        assert_same_commands(bundle, controller)
