"""What is asked about: a recording that code has made, or a robot that drives in the stand-in."""

from __future__ import annotations

import zlib
from collections.abc import Generator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from tests.judging.checks.judging import HEALTHY
from tests.judging.checks.labelled import FAULTS, WRITTEN, healthy, record
from tests.recordings.drawn import DRAWN
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, bundled
from webots_mcp.database.connection import connect, create_schema
from webots_mcp.standin import Simulation

RECORDED_BY_CODE = {*DRAWN, HEALTHY, *FAULTS, *WRITTEN}
LIVE, NOTHING = "live", "nothing"


@contextmanager
def subject(of: str, folder: Path) -> Generator[Path]:
    """The database of a subject in a folder that is there; while it is asked, a live one drives."""
    file = folder / DATABASE_NAME
    if of in DRAWN:
        DRAWN[of](folder)
    elif of in RECORDED_BY_CODE:
        _draw_labelled(of, file)
    elif of == LIVE:
        with Simulation(
            bundled("examples") / "worlds" / "arena.wbt",
            environment={DATA_DIR_VARIABLE: str(folder)},
        ) as simulation:
            simulation.wait_for(lambda: _has_rows(file), 60)
            yield file
            return
    elif of != NOTHING:
        raise ValueError(f"there is no subject {of!r}")
    yield file


def _draw_labelled(kind: str, file: Path) -> None:
    rng = np.random.default_rng([1, 0, zlib.crc32(kind.encode())])
    run = healthy(rng)
    if kind in FAULTS:
        run = FAULTS[kind][0](rng, run)
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
        record(connection, run, WRITTEN[kind][0] if kind in WRITTEN else "")


def _has_rows(file: Path) -> bool:
    if not file.exists():
        return False
    with closing(connect(file, "reader")) as connection:
        made = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'state'").fetchone()
        return bool(made and connection.execute("SELECT 1 FROM state LIMIT 1").fetchone())
