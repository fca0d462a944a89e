"""A first regression test of a project: does its controller command what it did in a run?"""

from __future__ import annotations

import tempfile
from contextlib import closing
from pathlib import Path
from typing import Final

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.rerun.running import current_file, find_taped_run, newest_taped_run
from webots_mcp.setup.file_change import FileChange, read
from webots_mcp.store.merging import write_bundle

_FOLDER: Final = "tests"
_RUNS: Final = "runs"
_NAME: Final = "test_same_commands.py"
_TEXT: Final = '''\
"""The controllers still command what they commanded in recorded runs; no simulator is needed.

Add a run: 'webots-mcp export --run 12 -o tests/runs/NAME.zip', and a line below. See
'webots-mcp help rerun'.
"""

from pathlib import Path

import pytest

from webots_mcp.testing import assert_same_commands

PROJECT = Path(__file__).parents[1]
RUNS = [
    ("{bundle}", "{controller}"),
]


@pytest.mark.parametrize(("run", "controller"), RUNS)
def test_the_controller_commands_the_same(run: str, controller: str) -> None:
    assert_same_commands(PROJECT / "tests" / "runs" / run, PROJECT / controller)
'''


def first_test(project: Path, data_dir: Path) -> tuple[FileChange, FileChange]:
    """Return the test of the newest run with a tape, and the bundle of that run.

    Args:
        project: The folder of the project.
        data_dir: The folder of its recording.

    Raises:
        NothingRecordedError: No run has a tape; the text says how to record one.
        InvalidInputError: The run goes on, or its controller is not there any more.
    """
    database = data_dir / DATABASE_NAME
    run_id = newest_taped_run(database, data_dir)
    controller = current_file(find_taped_run(database, data_dir, run_id))
    named = controller.resolve().relative_to(project.resolve()).as_posix()
    bundle = project / _FOLDER / _RUNS / f"run_{run_id}.zip"
    test = project / _FOLDER / _NAME
    text = _TEXT.format(bundle=bundle.name, controller=named)
    with tempfile.TemporaryDirectory(prefix="webots-mcp-") as folder:
        packed = Path(folder) / bundle.name
        with closing(connect(database, "reader")) as connection:
            write_bundle(connection, database, data_dir, run_id, packed)
        content = packed.read_bytes()
    before = read(bundle)
    return (
        FileChange(test, read(test), text.encode()),
        FileChange(bundle, before, before or content),  # a run does not change
    )
