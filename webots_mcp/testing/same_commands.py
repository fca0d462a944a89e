"""A regression test of a controller from a recorded run: does it still command the same?"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.location import resolve_database
from webots_mcp.rerun.running import Rerun, find_taped_run, newest_taped_run, rerun


def assert_same_commands(
    run: int | str | Path, file: str | Path, until_s: float | None = None
) -> Rerun:
    """Run a controller on the tape of a run, and fail where it commands something else.

        assert_same_commands("tests/runs/wall.zip", "controllers/rover/rover.py", until_s=15.0)

    It needs no simulator. 'webots-mcp export --run 12 -o tests/runs/wall.zip' makes such a file of
    a run that was recorded with a tape.

    Args:
        run: The id of a run of this project's recording, a .zip bundle, or a webots.db, of which
            the newest run with a tape is taken.
        file: The controller.
        until_s: Simulation time of the run up to which it must command the same.

    Returns:
        The outcome, which is `equal`.

    Raises:
        AssertionError: It commands something else; the text says when, what and at which line.
        WebotsMCPError: There is no such run, or it has no tape.
    """
    with ExitStack() as stack:
        if isinstance(run, int):
            database, data_dir = resolve_database()
            taped = find_taped_run(database, data_dir, run)
        else:
            found = Path(run)
            if found.suffix == ".zip":
                from webots_mcp.store.merging import unpacked

                found = stack.enter_context(unpacked(found))
            elif found.is_dir():
                found /= DATABASE_NAME
            taped = find_taped_run(found, found.parent, newest_taped_run(found, found.parent))
            if Path(run).suffix == ".zip":  # whose tape must not choose the Python that runs it
                taped = taped._replace(is_imported=True)
        outcome = rerun(taped, Path(file).resolve(), until_s=until_s)
    if outcome.outcome != "equal" or outcome.exception:
        raise AssertionError(outcome.text)
    return outcome
