"""What is asked about: a recording that code has made, or a robot that drives in the stand-in."""

from __future__ import annotations

import zlib
from collections.abc import Generator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.evaluations.recordings import INSTRUCTION, MISLEADING, record_misleading
from tests.judging.checks.judging import HEALTHY
from tests.judging.checks.labelled import FAULTS, WRITTEN, healthy, record
from tests.recordings.drawn import DRAWN
from tests.server.story import copy_of
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, bundled
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.standin import Simulation
from webots_mcp.testing import RobotRecording

NOTHING, LIVE, PAUSED, INSTRUCTED, TAG = "nothing", "live", "paused", "instructed", "live tag"
_ARENA = "worlds/arena.wbt"
WORLDS = {LIVE: _ARENA, PAUSED: _ARENA, INSTRUCTED: _ARENA, TAG: "tag/worlds/tag.wbt"}
_START_TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Subject:
    """A database that questions are asked of, and the simulation that writes it, if one runs.

    Attributes:
        last_command_id: The newest command when the question was asked; 0 without any.
    """

    file: Path
    simulation: Simulation | None = None
    last_command_id: int = 0


@contextmanager
def subject(of: str) -> Generator[Subject]:
    """Make a subject in a folder of its own; it lasts as long as the `with` statement."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / DATABASE_NAME
        if of in WORLDS:
            with Simulation(
                bundled("examples") / WORLDS[of], environment={DATA_DIR_VARIABLE: name}
            ) as simulation:
                robots = len(simulation.controllers)
                simulation.wait_for(lambda: _recording_robots(file) == robots, _START_TIMEOUT_S)
                _prepare(of, file, simulation)
                yield Subject(file, simulation, _last_command_id(file))
        elif of == NOTHING:
            yield Subject(file)
        else:
            copy_of(_recording(of), file)
            yield Subject(file, None, _last_command_id(file))


def _prepare(of: str, file: Path, simulation: Simulation) -> None:
    if of == PAUSED:
        pause = RobotRecording(file).send("pause")
        simulation.wait_for(lambda: pause.status == "done", _START_TIMEOUT_S)
    if of == INSTRUCTED:
        with closing(connect(file, "writer")) as connection:
            connection.execute(
                "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
                "SELECT run_id, sim_time_s, wall_time_s, 'warning', 'controller', ? FROM state "
                "ORDER BY id DESC LIMIT 1",
                (INSTRUCTION,),
            )


@cache
def _kept_folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory()


@cache
def _recording(of: str) -> Path:
    """Make a recording once per process; scenarios get copies of it."""
    folder = Path(_kept_folder().name, of)
    folder.mkdir()
    file = folder / DATABASE_NAME
    if of in DRAWN:
        DRAWN[of](folder)
    elif of in MISLEADING:
        record_misleading(of, folder)
    elif of in {HEALTHY, *FAULTS, *WRITTEN}:
        _record_labelled(of, file)
    else:
        raise ValueError(f"there is no subject {of!r}")
    return file


def _record_labelled(kind: str, file: Path) -> None:
    rng = np.random.default_rng([1, 0, zlib.crc32(kind.encode())])
    run = healthy(rng)
    if kind in FAULTS:
        run = FAULTS[kind][0](rng, run)
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        record(connection, run, WRITTEN[kind][0] if kind in WRITTEN else "")


def _recording_robots(file: Path) -> int:
    """Return how many robots have recorded a state."""
    if not file.exists():
        return 0
    with closing(connect(file, "reader")) as connection:
        tables = "SELECT count(*) FROM sqlite_master WHERE name IN ('state', 'run')"
        if connection.execute(tables).fetchone()[0] < 2:
            return 0
        robots = "SELECT count(DISTINCT robot_id) FROM state JOIN run ON run.id = run_id"
        return connection.execute(robots).fetchone()[0]


def _last_command_id(file: Path) -> int:
    with closing(connect(file, "reader")) as connection:
        return connection.execute("SELECT coalesce(max(id), 0) FROM command").fetchone()[0]
