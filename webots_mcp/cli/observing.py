"""The observer: put into a world, taken out again, and run as an extern controller."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.cli.command import DATA_DIR, argument, command
from webots_mcp.cli.setting_up import apply_change, diff_of, print_json, require_yes
from webots_mcp.contract import OBSERVER_NAME, find_project
from webots_mcp.errors import CommandRefusedError
from webots_mcp.observer.observe import PERIOD_MS, checked_period

if TYPE_CHECKING:
    from webots_mcp.setup.file_changes import FileChange

_URL: Final = "WEBOTS_CONTROLLER_URL"


@command(
    "observe",
    argument("--robot", default=OBSERVER_NAME, metavar="NAME",
             help=f"the Robot node to be, with supervisor TRUE ({OBSERVER_NAME})"),
    argument("--url", metavar="URL",
             help="where Webots is: ipc://1234, tcp://192.168.1.5:1234 (default: here, port 1234)"),
    argument("--period-ms", type=int, default=PERIOD_MS, metavar="N",
             help=f"simulation time between two rows ({PERIOD_MS})"),
    DATA_DIR,
)  # fmt: skip
def observe(arguments: argparse.Namespace) -> None:
    """Record where all robots of a running world are, as an extern controller of it.

    The world needs a robot for it, which 'webots-mcp init --observer WORLD --extern' adds; without
    --extern Webots starts the observer itself, and this command is not needed. It ends when Webots
    reloads the world or ends.
    """
    period_ms = checked_period(arguments.period_ms)
    _prepare(arguments)
    from controller import Supervisor  # type: ignore[import-not-found]

    from webots_mcp.observer.observe import observe as run

    run(Supervisor(), period_ms, data_dir=arguments.data_dir)


def _prepare(arguments: argparse.Namespace) -> None:
    """What Webots' library needs to find its simulator, where that is not set already."""
    from webots_mcp.webots.installations import HOME_VARIABLE, installations
    from webots_mcp.webots.instances import DEFAULT_PORT

    url = arguments.url or os.environ.get(_URL) or f"ipc://{DEFAULT_PORT}"
    os.environ[_URL] = f"{url.rstrip('/')}/{arguments.robot}" if url.count("/") == 2 else url
    found = next((each for each in installations() if each.python_api), None)
    if found is not None and found.python_api is not None:
        os.environ.setdefault(HOME_VARIABLE, str(found.home))
        sys.path.append(str(found.python_api))
    try:
        import controller  # type: ignore[import-not-found]  # noqa: F401
    except (ImportError, KeyError, OSError) as error:
        raise CommandRefusedError(
            f"Webots' Python package 'controller' cannot be used ({error}): set {HOME_VARIABLE} "
            "to the folder of Webots"
        ) from error


def add_observer(arguments: argparse.Namespace) -> None:
    """Put the observer into a copy of a world, or into the world itself."""
    from webots_mcp.setup.observed_world import controller_change, world_change
    from webots_mcp.setup.webots_project import project_of

    world = Path(arguments.observer)
    change = world_change(world, in_place=arguments.in_place, extern=arguments.extern)
    project = project_of(str(world.resolve().parent))
    changes = [change] if arguments.extern else [controller_change(project), change]
    for each in changes:
        _require_agreed(arguments, each, is_meant=arguments.in_place and each is change)
    files = [apply_change(each, dry_run=arguments.dry_run) for each in changes]
    if not arguments.extern and not arguments.dry_run:
        files += _python_for(changes[0].file)
    _tell(arguments, files, f"open {change.file} in Webots" + _then(arguments))


def _then(arguments: argparse.Namespace) -> str:
    return ", and run 'webots-mcp observe'" if arguments.extern else ""


def _require_agreed(arguments: argparse.Namespace, change: FileChange, *, is_meant: bool) -> None:
    """What a file holds that somebody has changed is not written over without a yes."""
    if change.before is None or not change.is_needed or is_meant or arguments.dry_run:
        return
    if not arguments.json:
        print(diff_of(change))
    require_yes(arguments, str(change.file))


def _python_for(controller: Path) -> list[dict[str, str]]:
    """The Python that can run the observer, where the one that Webots takes cannot."""
    from webots_mcp.setup.observed_world import python_change
    from webots_mcp.setup.webots_project import look_into

    found = look_into(controller)
    if found.error is None:
        return []
    change = python_change(controller, sys.executable)
    if change.before is None:
        return [apply_change(change, dry_run=False)]
    note = f"{found.error}: {found.fix}"
    return [{"file": str(change.file), "outcome": "unchanged", "note": note}]


def remove_observer(arguments: argparse.Namespace) -> None:
    """Take the observer out of a world, or delete the copy that was made for it."""
    from webots_mcp.setup.observed_world import undo, unused_controller

    world = Path(arguments.undo)
    change = undo(world)
    if not arguments.dry_run:
        require_yes(arguments, str(world))
    if change is None:
        files = [_deleted(world, dry_run=arguments.dry_run)]
    else:
        files = [apply_change(change, dry_run=arguments.dry_run)]
    project = find_project(world.resolve().parent)
    if project is not None:
        unused = unused_controller(project, sys.executable)
        files += [_deleted(file, dry_run=arguments.dry_run) for file in unused]
        _remove_empty(unused)
    _tell(arguments, files, None)


def _deleted(file: Path, *, dry_run: bool) -> dict[str, str]:
    if not dry_run:
        file.unlink()
    return {"file": str(file), "outcome": "would be deleted" if dry_run else "deleted"}


def _remove_empty(files: list[Path]) -> None:
    for folder in {file.parent for file in files}:
        if not any(folder.iterdir()):
            folder.rmdir()


def _tell(arguments: argparse.Namespace, files: list[dict[str, str]], then: str | None) -> None:
    if arguments.json:
        told: dict[str, Any] = {"files": files}
        return print_json(told | ({"then": then} if then else {}))
    for each in files:
        note = f" ({each['note']})" if "note" in each else ""
        print(f"{each['outcome']}: {each['file']}{note}")
    if then and not arguments.dry_run:
        print(then)
