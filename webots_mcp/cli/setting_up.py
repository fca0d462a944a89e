"""The command that makes a Webots project ready."""

from __future__ import annotations

import argparse
import difflib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from webots_mcp.cli.command import JSON, argument, command
from webots_mcp.cli.tables import print_notes
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError

if TYPE_CHECKING:
    from webots_mcp.setup.client_entries import Client
    from webots_mcp.setup.file_changes import FileChange
    from webots_mcp.setup.webots_project import ProjectController


@command(
    "init",
    argument("project", nargs="?", metavar="PROJECT",
             help="a folder in the project (default: the current one)"),
    argument("--claude-desktop", action="store_true",
             help="tell Claude Desktop too, whose file is not in the project"),
    argument("--name", default="webots", help="what clients call the server (webots)"),
    argument("--patch", metavar="FILE",
             help="put the bridge's lines into this controller, and do nothing else"),
    argument("--observer", metavar="WORLD",
             help="add a robot that records where all robots are, to a copy of this world"),
    argument("--in-place", action="store_true", help="with --observer: to the world itself"),
    argument("--extern", action="store_true",
             help="with --observer: to be run by 'webots-mcp observe', not by Webots"),
    argument("--undo", metavar="FILE",
             help="take the bridge's lines out of a controller, or the observer out of a world"),
    argument("--yes", action="store_true", help="change what is there without asking"),
    argument("--dry-run", action="store_true", help="write nothing, and say what would be written"),
    JSON,
)  # fmt: skip
def init(arguments: argparse.Namespace) -> None:
    """Make a Webots project ready: tell MCP clients of the server, look at the controllers.

    The project is the nearest folder with worlds/ and controllers/. Claude Code (.mcp.json), Cursor
    (.cursor/mcp.json) and VS Code (.vscode/mcp.json) are told of the server, by a full path;
    other entries and comments stay. Of each controller in Python the lines that it needs are
    shown, the Python that Webots starts it with, and what mends that where the bridge is not
    installed there. Nothing is changed a second time.

    --patch writes those lines, after a question:

        webots-mcp init --patch controllers/my_robot/my_robot.py

    --observer adds a robot to a copy of a world (arena_observed.wbt, say), and its controller to
    the project; then nothing has to be changed in any controller:

        webots-mcp init --observer worlds/arena.wbt
    """
    if sum(map(bool, (arguments.patch, arguments.undo, arguments.observer))) > 1:
        raise InvalidInputError("--patch, --observer and --undo exclude each other")
    if (arguments.in_place or arguments.extern) and not arguments.observer:
        raise InvalidInputError("--in-place and --extern say what --observer WORLD does")
    if arguments.observer:
        from webots_mcp.cli.observing import add_observer

        return add_observer(arguments)
    if arguments.undo and arguments.undo.endswith(".wbt"):
        from webots_mcp.cli.observing import remove_observer

        return remove_observer(arguments)
    if arguments.patch or arguments.undo:
        return _change_controller(arguments)
    _make_ready(arguments)


def _change_controller(arguments: argparse.Namespace) -> None:
    from webots_mcp.setup.controller_patch import AlreadyPatchedError, patch, unpatch
    from webots_mcp.setup.file_changes import FileChange, apply, read

    file, change = (arguments.patch, patch) if arguments.patch else (arguments.undo, unpatch)
    if Path(file).is_dir():
        raise InvalidInputError(f"{file} is a folder: name the controller's file in it")
    before = read(Path(file))
    if before is None:
        raise InvalidInputError(f"there is no file {file}")
    try:
        wanted = FileChange(Path(file), before, change(before))
    except AlreadyPatchedError as error:
        return _tell_patched(arguments, file, "unchanged", note=f"already patched: {error}")
    except InvalidInputError as error:
        raise InvalidInputError(f"{file} is left as it is: {error}") from error
    diff = diff_of(wanted)
    if not arguments.json:
        print(diff)
    if not arguments.dry_run:
        require_yes(arguments, file)
        apply(wanted)
    done = "would be written" if arguments.dry_run else "written"
    _tell_patched(arguments, file, done, diff=diff)


def _tell_patched(arguments: argparse.Namespace, file: str, outcome: str, **more: str) -> None:
    if arguments.json:
        return print_json({"file": file, "outcome": outcome, **more})
    print(f"{file}: {more.get('note', outcome)}")


def diff_of(change: FileChange) -> str:
    """The lines that change, whatever the file's encoding."""
    before, after = (
        (content or b"").decode("utf-8", "replace").splitlines()
        for content in (change.before, change.after)
    )
    names = str(change.file), f"{change.file} (new)"
    return "\n".join(difflib.unified_diff(before, after, *names, lineterm="", n=2))


def require_yes(arguments: argparse.Namespace, file: str) -> None:
    """Ask whether a file may be written.

    Raises:
        CommandRefusedError: It may not, or nobody can be asked.
    """
    if arguments.yes:
        return
    if not sys.stdin.isatty() or arguments.json:
        raise CommandRefusedError(f"{file} is left as it is: --yes writes it")
    try:
        answer = input(f"Write {file}? [y/N] ")
    except EOFError:
        answer = ""
    if answer.strip().lower() not in ("y", "yes"):
        raise CommandRefusedError(f"{file} is left as it is")


def print_json(found: dict[str, Any]) -> None:
    """Print an answer for programs."""
    print(json.dumps(found, ensure_ascii=False))


def _make_ready(arguments: argparse.Namespace) -> None:
    from webots_mcp.contract import PROJECT_DATA_FOLDER
    from webots_mcp.setup.client_entries import (
        claude_desktop,
        clients_of,
        server_command,
        server_hindrance,
    )
    from webots_mcp.setup.webots_project import controllers_of, project_of

    project = project_of(arguments.project)
    data_dir = project / PROJECT_DATA_FOLDER
    clients = clients_of(project) + ([claude_desktop()] if arguments.claude_desktop else [])
    line = server_command(data_dir)
    files = [_ignored(data_dir, dry_run=arguments.dry_run)]
    files += [_told(client, line, arguments) for client in clients]
    controllers = [_described(found, project) for found in controllers_of(project)]
    note = server_hindrance()
    found = {"project": str(project), "server": line, "files": files, "controllers": controllers}
    if arguments.json:
        print_json(found | ({"note": note} if note else {}))
    else:
        _print(found, [note] if note else [])
    refused = [each["file"] for each in files if each["outcome"] == "refused"]
    if refused:
        raise CommandRefusedError(f"not written: {', '.join(refused)}; the reasons are above")


def _ignored(data_dir: Path, *, dry_run: bool) -> dict[str, str]:
    from webots_mcp.contract import make_folder
    from webots_mcp.setup.client_entries import ignore_file

    file = data_dir / ".gitignore"
    try:
        change = ignore_file(data_dir)
        if change.is_needed and not dry_run:
            make_folder(data_dir)
        return apply_change(change, dry_run=dry_run)
    except (WebotsMCPError, OSError) as error:
        return {"file": str(file), "outcome": "refused", "note": str(error)}


def _told(client: Client, line: list[str], arguments: argparse.Namespace) -> dict[str, str]:
    from webots_mcp.setup.client_entries import plan_entry

    named = {"client": client.name}
    try:
        entry = plan_entry(client, arguments.name, line)
        note = {"note": entry.note} if entry.note else {}
        return named | apply_change(entry.change, dry_run=arguments.dry_run) | note
    except (WebotsMCPError, OSError) as error:
        return {**named, "file": str(client.file), "outcome": "refused", "note": str(error)}


def apply_change(change: FileChange, *, dry_run: bool) -> dict[str, str]:
    """Write a file unless it holds that already or nothing is to be written; what was done."""
    from webots_mcp.setup.file_changes import apply

    if not change.is_needed:
        return {"file": str(change.file), "outcome": "unchanged"}
    if not dry_run:
        apply(change)
    return {"file": str(change.file), "outcome": "would be written" if dry_run else "written"}


def _described(controller: ProjectController, project: Path) -> dict[str, Any]:
    """A controller, the lines that it needs, and the Python that it is started with."""
    from dataclasses import asdict

    from webots_mcp.setup.controller_patch import IMPORT, AlreadyPatchedError, attach_line
    from webots_mcp.setup.webots_project import look_into

    file = controller.file.relative_to(project)
    told: dict[str, Any] = {"file": file.as_posix(), "language": controller.language}
    if not controller.is_python:
        return told
    try:
        told["lines"] = [IMPORT, attach_line(controller.file.read_bytes())]
    except AlreadyPatchedError as error:
        told["has_bridge"] = str(error)
    except (InvalidInputError, OSError) as error:
        told["unclear"] = str(error)
    python = asdict(look_into(controller.file))
    return told | {"python": {name: value for name, value in python.items() if value is not None}}


def _print(found: dict[str, Any], notes: list[str]) -> None:
    print(f"project {found['project']}\n")
    for each in found["files"]:
        note = f" ({each['note']})" if "note" in each else ""
        print(f"  {each['outcome']}: {each['file']}{note}")
    for each in found["controllers"]:
        print(f"\n{each['file']}")
        _print_controller(each)
    fixes = dict.fromkeys(
        each["python"]["fix"] for each in found["controllers"] if "fix" in each.get("python", {})
    )
    if fixes:
        print("\nWhat mends that:\n")
        print("\n".join(f"    {fix}" for fix in fixes))
    if not found["controllers"]:
        notes = [*notes, "there is no controller yet: run it again when there is"]
    print()
    print_notes(notes)


def _print_controller(told: dict[str, Any]) -> None:
    if "python" not in told:
        print(f"  is {told['language']}: the bridge is for controllers in Python")
        return
    if "lines" in told:
        print("  needs these lines, the second where the robot is made (or: --patch)\n")
        print("".join(f"      {line}\n" for line in told["lines"]))
    elif "unclear" in told:
        print(f"  where the lines belong is not clear: {told['unclear']}")
    else:
        print(f"  {told['has_bridge']}")
    _print_python(told["python"])


def _print_python(python: dict[str, Any]) -> None:
    version = f", {python['executable']}, Python {python['python']}" if "python" in python else ""
    print(f"  is started with {python['command']!r} ({python['chosen_by']}){version}")
    if "error" not in python:
        print(f"  which has webots-mcp {python['bridge']}")
        return
    print(f"  where the bridge cannot be used: {python['error']}")
