"""Define the commands that set up a project and explain what does not work."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import textwrap
from collections import Counter
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from webots_mcp.cli.options import HERE, Json, Parameter, Where
from webots_mcp.cli.streams import shown_activity
from webots_mcp.cli.terminal import print_json, print_notes, printable, terminal_width
from webots_mcp.cli.wording import as_typed
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from webots_mcp.setup.doctor import Checked, Examined
    from webots_mcp.setup.file_change import FileChange
    from webots_mcp.simulator.project import ProjectController


@Parameter(name="*")
@dataclass(frozen=True)
class Writing:
    """Whether files are written, and how to ask before writing."""

    yes: Annotated[
        bool, Parameter("--yes", negative=(), help="Change existing files without asking.")
    ] = False
    dry_run: Annotated[
        bool,
        Parameter("--dry-run", negative=(), help="Show what would be written, and write nothing."),
    ] = False
    as_json: Json = False

    def require_yes(self, file: Path) -> None:
        """Ask whether a file may be written.

        Raises:
            CommandRefusedError: The answer was no, or nobody can be asked.
        """
        if self.yes or self.dry_run:
            return
        if not sys.stdin.isatty() or self.as_json:
            raise CommandRefusedError(
                f"{file} was not changed, because nobody can be asked here. Repeat with --yes to "
                f"write it."
            )
        try:
            answer = input(f"Write {file}? [y/N] ")
        except EOFError:
            answer = ""
        if answer.strip().lower() not in ("y", "yes"):
            raise CommandRefusedError(f"{file} was not changed.")

    def require_yes_to(self, change: FileChange) -> None:
        """Show the lines that change, and ask whether they may.

        Raises:
            CommandRefusedError: The answer was no, or nobody can be asked.
        """
        if not self.as_json:
            print(change.diff)
        self.require_yes(change.file)

    def apply(self, change: FileChange) -> dict[str, str]:
        """Write a file unless it already has this content. Return what was done."""
        from webots_mcp.setup.file_change import apply

        if not change.is_needed:
            return {"file": str(change.file), "outcome": "unchanged"}
        if not self.dry_run:
            apply(change)
        return self._done(change.file, "written")

    def delete(self, file: Path) -> dict[str, str]:
        """Delete a file. Return what was done."""
        if not self.dry_run:
            file.unlink()
        return self._done(file, "deleted")

    def _done(self, file: Path, outcome: str) -> dict[str, str]:
        return {"file": str(file), "outcome": f"would be {outcome}" if self.dry_run else outcome}


_ASKING: Final = Writing()


def init(
    project: Annotated[
        str | None, Parameter("PROJECT", help="Folder in the project. Default: the current folder.")
    ] = None,
    /,
    *,
    claude_desktop: Annotated[
        bool,
        Parameter(
            "--claude-desktop",
            help="Also register with Claude Desktop, whose file is outside the project.",
        ),
    ] = False,
    name: Annotated[
        str,
        Parameter("--name", metavar="NAME", help="Name of the server in clients. Default: webots."),
    ] = "webots",
    http: Annotated[
        str | None,
        Parameter(
            "--http",
            metavar="URL",
            help="Register a running server instead, such as http://127.0.0.1:8000/mcp. Clients "
            "read its token from the environment variable WEBOTS_MCP_TOKEN.",
        ),
    ] = None,
    skills: Annotated[
        bool,
        Parameter(
            "--skills",
            help="Also install skills in .claude/skills and AGENTS.md. Your own changes stay.",
        ),
    ] = False,
    patch: Annotated[
        Path | None,
        Parameter(
            "--patch",
            metavar="FILE",
            help="Only add the lines that record to this controller, after asking.",
        ),
    ] = None,
    observer: Annotated[
        Path | None,
        Parameter(
            "--observer",
            metavar="WORLD",
            help="Only add a robot that records all positions, to a copy of this world.",
        ),
    ] = None,
    in_place: Annotated[
        bool, Parameter("--in-place", help="With --observer: change the world itself, not a copy.")
    ] = False,
    extern: Annotated[
        bool,
        Parameter(
            "--extern",
            help="With --observer: 'webots-mcp observe' runs it, instead of Webots.",
        ),
    ] = False,
    undo: Annotated[
        Path | None,
        Parameter(
            "--undo",
            metavar="FILE",
            help="Remove these lines from a controller, or the observer from a world.",
        ),
    ] = None,
    tests: Annotated[
        bool,
        Parameter(
            "--tests",
            negative=(),
            help="Only write a first test: the controller commands what it did in the newest run "
            "with a tape.",
        ),
    ] = False,
    writing: Writing = _ASKING,
) -> None:
    """Set up a Webots project: register the MCP server and list what each controller needs.

        webots-mcp init ~/my_project --skills

    Registers the server with Claude Code (.mcp.json), Cursor (.cursor/mcp.json) and VS Code
    (.vscode/mcp.json); other entries stay. The project is the nearest folder with worlds/. In WSL,
    a project on a Windows drive gets the server of Windows. Running it again changes nothing.

    For each Python controller it shows the two lines that record, the Python that Webots runs it
    with, and how to install webots-mcp there. --patch adds these lines for you:

        webots-mcp init --patch controllers/my_robot/my_robot.py

    --skills installs guides for assistants, such as "why does it not move" and "did my edit help".
    Repeat it after an update.

    --observer records positions without changing any controller. It adds a robot to a copy of the
    world, here arena_observed.wbt:

        webots-mcp init --observer worlds/arena.wbt
    """
    from webots_mcp.setup import project_edits

    if sum(each is not None for each in (patch, undo, observer)) + tests > 1:
        raise InvalidInputError(
            "--patch, --observer, --undo and --tests exclude each other. Give one of them."
        )
    if (in_place or extern) and observer is None:
        raise InvalidInputError(
            "--in-place and --extern apply only to --observer. Add --observer WORLD, or leave them "
            "out."
        )
    if tests:
        _write_first_test(project, writing)
    elif observer is not None:
        _add_observer(observer, writing, in_place=in_place, extern=extern)
    elif undo is not None and undo.suffix == ".wbt":
        _remove_observer(undo, writing)
    elif undo is not None:
        _change_controller(undo, project_edits.unpatch, writing)
    elif patch is not None:
        _change_controller(patch, project_edits.patch, writing)
    else:
        _make_ready(project, name, writing, http, claude_desktop=claude_desktop, skills=skills)


def _write_first_test(folder: str | None, writing: Writing) -> None:
    from webots_mcp.contract import PROJECT_DATA_FOLDER
    from webots_mcp.setup.first_test import first_test
    from webots_mcp.simulator.project import project_of

    project = project_of(folder)
    test, bundle = first_test(project, project / PROJECT_DATA_FOLDER)
    if test.before is not None and test.is_needed:
        writing.require_yes_to(test)
    if not writing.dry_run:
        bundle.file.parent.mkdir(parents=True, exist_ok=True)
    files = [writing.apply(each) for each in (bundle, test)]
    _print_files(files, writing, then=f"pytest {_shown(test.file)}")


def _change_controller(file: Path, changed: Callable[[bytes], bytes], writing: Writing) -> None:
    from webots_mcp.database.location import find_project
    from webots_mcp.setup import project_edits
    from webots_mcp.setup.file_change import FileChange, read
    from webots_mcp.setup.project_edits import AlreadyPatchedError

    if file.is_dir():
        raise InvalidInputError(f"{file} is a folder. Name the controller's file in it.")
    before = read(file)
    if before is None:
        raise InvalidInputError(f"There is no file {file}. Check the path.")
    if file.suffix != ".py":
        own = "'webots-mcp init' lists what controllers in other languages need"
        raise InvalidInputError(f"{file} is not a Python file and was not changed; {own}.")
    try:
        change = FileChange(file, before, changed(before))
    except AlreadyPatchedError as error:
        there = {"file": str(file), "outcome": "unchanged", "note": f"already patched: {error}"}
        return _print_files([there], writing)
    except InvalidInputError as error:
        raise InvalidInputError(f"{file} was not changed: {error}") from error
    writing.require_yes_to(change)
    project = find_project(file.resolve().parent)
    launch = _launch_line(project) if project and changed is project_edits.patch else None
    _print_files([writing.apply(change) | {"diff": change.diff}], writing, then=launch)


def _add_observer(world: Path, writing: Writing, *, in_place: bool, extern: bool) -> None:
    """Put the observer into a copy of a world, or into the world itself."""
    from webots_mcp.setup.observer_edits import controller_change, world_change
    from webots_mcp.simulator.project import project_of

    change = world_change(world, in_place=in_place, extern=extern)
    project = project_of(str(world.resolve().parent))
    changes = [change] if extern else [controller_change(project), change]
    for each in changes:  # a file that somebody has changed is overwritten only after a yes
        is_meant = in_place and each is change
        if each.before is not None and each.is_needed and not is_meant:
            writing.require_yes_to(each)
    files = [writing.apply(each) for each in changes]
    if not extern and not writing.dry_run:
        files += _python_for(changes[0].file, writing)
    run_it = ", and run 'webots-mcp observe'" if extern else ""
    _print_files(files, writing, then=f"open {change.file} in Webots{run_it}")


def _python_for(controller: Path, writing: Writing) -> list[dict[str, str]]:
    """Return the Python that can run the observer, if the one that Webots takes cannot."""
    from webots_mcp.setup.interpreter import probe_interpreter
    from webots_mcp.setup.observer_edits import python_change

    found = probe_interpreter(controller)
    if found.error is None:
        return []
    change = python_change(controller, sys.executable)
    if change.before is None:
        unshared = "names the Python of this machine: add it to .gitignore"
        note = {"note": unshared} if _is_shared(change.file) else {}
        return [writing.apply(change) | note]
    note = f"{found.error}: {found.fix}"
    return [{"file": str(change.file), "outcome": "unchanged", "note": note}]


def _remove_observer(world: Path, writing: Writing) -> None:
    """Take the observer out of a world, or delete the copy that was made for it."""
    from webots_mcp.contract import CONTROLLER_FOLDER, WORLD_ENDING, WORLD_FOLDER
    from webots_mcp.database.location import find_project
    from webots_mcp.setup.observer_edits import undo, unused_controller

    change = undo(world)
    writing.require_yes(world)
    files = [writing.delete(world) if change is None else writing.apply(change)]
    project = find_project(world.resolve().parent)
    if project is not None:
        unused = unused_controller(project, sys.executable)
        files += [writing.delete(file) for file in unused]
        for folder in {file.parent for file in unused}:
            _remove_if_empty(folder)
            if any((project / WORLD_FOLDER).glob(f"*{WORLD_ENDING}")):  # it remains a project
                _remove_if_empty(project / CONTROLLER_FOLDER)
    _print_files(files, writing)


def _remove_if_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _print_files(
    files: Sequence[dict[str, str]], writing: Writing, *, then: str | None = None
) -> None:
    """Report what was done with each file, and what to do next."""
    if writing.as_json:
        return print_json({"files": files} | ({"then": then} if then else {}))
    for each in files:
        print(_outcome(each))
    if then and not writing.dry_run:
        print(f"Next: {then}")


def _outcome(file: dict[str, str]) -> str:
    note = f" ({file['note']})" if "note" in file else ""
    return f"{file['outcome']}: {file['file']}{note}"


def _make_ready(
    folder: str | None,
    name: str,
    writing: Writing,
    http: str | None,
    *,
    claude_desktop: bool,
    skills: bool,
) -> None:
    """Register the server with clients, and list what the controllers need."""
    from webots_mcp.contract import PROJECT_DATA_FOLDER, PROJECT_FILE
    from webots_mcp.setup import client_entries
    from webots_mcp.setup.skills import managed_texts
    from webots_mcp.setup.wsl import windows_server
    from webots_mcp.simulator.project import controllers_of, project_of

    if http is not None and not re.fullmatch(r"https?://[^\s/@]+(/\S*)?", http):
        raise InvalidInputError(
            f"--http {http!r} is not a URL of a server without user and password. Give a URL such "
            "as http://127.0.0.1:8000/mcp."
        )
    project = project_of(folder)
    data_dir = project / PROJECT_DATA_FOLDER
    of_windows, border = (None, None) if http else windows_server(project)
    # a database that should not be shared
    expected = None if of_windows else _expected(data_dir, writing)
    clients = client_entries.clients_of(project)
    clients += [client_entries.claude_desktop()] if claude_desktop else []
    line = http or of_windows or client_entries.server_command(data_dir)
    files = [
        _written(data_dir / ".gitignore", writing, partial(_ignored, data_dir, writing)),
        _written(project / PROJECT_FILE, writing, partial(_allowed, project)),
    ]
    for each in clients:
        planned = partial(client_entries.plan_entry, each, name, line)
        files += [{"client": each.name} | _written(each.file, writing, planned)]
    files += [_written(e.file, writing, e.plan) for e in managed_texts(project)] if skills else []
    controllers = [_described(found, project) for found in controllers_of(project)]
    hindrance = None if http or of_windows else client_entries.server_hindrance()
    shared = None if http else _machine_paths(project, files)
    notes = [note for note in (border, hindrance, expected, shared) if note]
    found = {"project": str(project), "server": line, "files": files, "controllers": controllers}
    found["next"] = _next_steps(project, controllers)
    if writing.as_json:
        print_json(found | ({"note": "; ".join(notes)} if notes else {}))
    else:
        _print_project(found, notes)
    refused = [each["file"] for each in files if each["outcome"] == "refused"]
    if refused:
        raise CommandRefusedError(
            f"{', '.join(refused)} could not be written. The reasons are above; fix them and "
            f"repeat."
        )


def _expected(data_dir: Path, writing: Writing) -> str | None:
    """Compile the project file for bridges. Return what it expects, or None without a file.

    Raises:
        InvalidInputError: The file is invalid.
    """
    from webots_mcp.contract import DATABASE_NAME
    from webots_mcp.database.connection import connect
    from webots_mcp.database.files import make_folder
    from webots_mcp.database.schema import create_schema, schema_version
    from webots_mcp.store.project_file import compile_project, file_of, read_project

    if (file := file_of(data_dir)) is None:
        return None
    project = read_project(file)
    if not any(project) and not (data_dir / DATABASE_NAME).exists():
        return None
    if not writing.dry_run:
        make_folder(data_dir)
        with closing(connect(data_dir / DATABASE_NAME, "writer", create=True)) as connection:
            if schema_version(connection) == 0:
                create_schema(connection)
            compile_project(connection, project)
    if not any(project):
        return None
    expected, signals = map(len, project)
    counted = f"{expected} expectation{'s' * (expected != 1)}"
    if signals:
        counted += f" and the meaning of {signals} signal{'s' * (signals != 1)}"
    return f"{file}: {counted}; webots-mcp check judges runs by what is there"


def _written(
    file: Path, writing: Writing, planned: Callable[[], tuple[FileChange, str | None]]
) -> dict[str, str]:
    """Return what was done with a file, with notes, or why it was left unchanged."""
    try:
        change, note = planned()
        return writing.apply(change) | ({"note": note} if note else {})
    except (WebotsMCPError, OSError, UnicodeError) as error:
        return {"file": str(file), "outcome": "refused", "note": str(error)}


def _allowed(project: Path) -> tuple[FileChange, str | None]:
    """Return what may be requested in the project, if the file does not say so yet."""
    from webots_mcp.setup.client_entries import policy_file
    from webots_mcp.store.policy import read_policy

    change = policy_file(project)
    is_open = not change.is_needed and read_policy(change.file) is None
    return change, "has no table [allow], so that all is allowed" if is_open else None


def _ignored(data_dir: Path, writing: Writing) -> tuple[FileChange, str | None]:
    """Return what keeps the recording out of the project's repository."""
    from webots_mcp.database.files import make_folder
    from webots_mcp.setup.client_entries import ignore_file

    change = ignore_file(data_dir)
    if change.is_needed and not writing.dry_run:
        make_folder(data_dir)
    return change, None


def _described(controller: ProjectController, project: Path) -> dict[str, Any]:
    """Return a controller, the lines that it needs, and the Python that starts it."""
    from dataclasses import asdict

    from webots_mcp.setup.interpreter import probe_interpreter
    from webots_mcp.setup.project_edits import (
        IMPORT,
        AlreadyPatchedError,
        attaching_place,
        is_plain_robot,
    )
    from webots_mcp.simulator.project import (
        NO_POSITION_OF_ITS_OWN,
        NO_SUPERVISOR,
        has_observer,
        offer_observer,
    )

    file = controller.file.relative_to(project)
    described: dict[str, Any] = {"file": file.as_posix(), "language": controller.language}
    if not controller.is_python:
        unbuilt = {} if controller.is_built else {"note": "Webots starts it once it is built"}
        return described | unbuilt | {"advice": controller.advice}
    try:
        place = attaching_place(controller.file)
        described["lines"] = [IMPORT, place.statement]
        described["lines_in"] = place.file.relative_to(project).as_posix()
        described["after_line"] = place.line
    except AlreadyPatchedError as error:
        described["has_bridge"] = str(error)
    except (InvalidInputError, OSError) as error:
        described["unclear"] = str(error)
    if is_plain_robot(controller.file) and not has_observer(project):
        lacks = f"its robot {NO_SUPERVISOR}. {NO_POSITION_OF_ITS_OWN}"
        described["lacks"] = f"{lacks}: {offer_observer(project)}"
    python = asdict(probe_interpreter(controller.file))
    known = {name: value for name, value in python.items() if value is not None}
    return described | {"python": known}


def _print_project(found: dict[str, Any], notes: list[str]) -> None:
    counts = Counter(each["outcome"] for each in found["files"])
    done = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    print(f"Project {found['project']}: files {done}.\n")
    for each in found["files"]:
        print(f"  {_outcome(each)}")
    for each in found["controllers"]:
        print(f"\n{each['file']}")
        _print_controller(each)
    if not found["controllers"]:
        notes = [
            *notes,
            "there is no controller in controllers/. Run this again once there is one. An extern "
            "controller or a ROS 2 driver records with two lines: 'from webots_mcp import "
            "MCPBridge' and, after it creates its robot, 'bridge = MCPBridge.attach(robot)'",
        ]
    print()
    print_notes(notes)
    if found["next"]:
        print("Next:")
    for number, each in enumerate(found["next"], 1):
        print(f"  {number}. {each}")


def _next_steps(project: Path, controllers: list[dict[str, Any]]) -> list[str]:
    """Return the commands that follow the setup of a project, and the first question."""
    from webots_mcp.simulator.installations import installations

    # The stand-in runs controllers with the Python of this command, which has the bridge.
    when = "" if installations() else "  # before Webots runs it; the stand-in does not need this"
    fixes = [
        each["python"]["fix"] + when for each in controllers if "fix" in each.get("python", {})
    ]
    steps = [
        f"webots-mcp init --patch {_shown(project / each['lines_in'])}"
        for each in controllers
        if "lines" in each
    ]
    launch = _launch_line(project)
    ask = "Open your assistant in the project and ask: What is the robot doing?"
    return [*dict.fromkeys([*fixes, *steps]), *([launch] if launch else []), ask]


def _launch_line(project: Path) -> str | None:
    """Return the command that runs the first world of a project; None without a world."""
    from webots_mcp.contract import WORLD_ENDING, WORLD_FOLDER
    from webots_mcp.simulator.installations import installations

    world = next(iter(sorted((project / WORLD_FOLDER).glob(f"*{WORLD_ENDING}"))), None)
    if world is None:
        return None
    without = "" if installations() else " --stand-in"
    why = " (no Webots was found on this machine)" if without else ""
    return f"webots-mcp launch {_shown(world)}{without}{why}"


def _shown(file: Path) -> str:
    """Return a path as typed in the current folder."""
    try:
        return shlex.quote(str(file.relative_to(Path.cwd())))
    except ValueError:
        return shlex.quote(str(file))


def _machine_paths(project: Path, files: Sequence[dict[str, str]]) -> str | None:
    """Return which written files do not belong in the project's repository, and why."""
    written = (Path(each["file"]) for each in files if "client" in each)
    names = [str(file.relative_to(project)) for file in written if _is_shared(file, project)]
    if not names:
        return None
    return (
        f"add {', '.join(names[:-1])}{' and ' * (len(names) > 1)}{names[-1]} to .gitignore: they "
        f"hold the path of webots-mcp on this machine, "
        "because clients do not search your PATH. Everyone else runs 'webots-mcp init' too"
    )


def _is_shared(file: Path, project: Path | None = None) -> bool:
    """Return whether a file lies in a Git repository that does not ignore it."""
    folder = project or file.parent
    if not file.resolve().is_relative_to(folder.resolve()):
        return False  # belongs to the user, not to the project
    asked = ["git", "-C", str(folder), "check-ignore", "--quiet", str(file)]
    try:
        return subprocess.run(asked, capture_output=True, check=False, timeout=10).returncode == 1
    except (OSError, subprocess.TimeoutExpired):  # Git is not installed
        return False


def _print_controller(described: dict[str, Any]) -> None:
    if "python" not in described:
        note = f" ({described['note']})" if "note" in described else ""
        _print_folded("  ", f"is {described['language']}{note}: {described['advice']}")
        return
    if "lines" in described:
        file = described["lines_in"]
        place = f" in {file}" if file != described["file"] else ""
        _print_folded(
            "  ",
            f"needs these lines{place}, the second after line {described['after_line']}, where "
            f"the robot is created (or: webots-mcp init --patch {file})",
        )
        print("\n" + "".join(f"      {line}\n" for line in described["lines"]))
    elif "unclear" in described:
        _print_folded("  ", f"where to add the lines is not clear: {described['unclear']}")
    else:
        print(f"  {described['has_bridge']}")
    if "lacks" in described:
        _print_folded("  ", described["lacks"])
    _print_python(described["python"])


def _print_python(python: dict[str, Any]) -> None:
    version = f", {python['executable']}, Python {python['python']}" if "python" in python else ""
    _print_folded(
        "  ", f"Webots runs it with {python['command']!r} ({python['chosen_by']}){version}"
    )
    if "error" not in python:
        print(f"  which has webots-mcp {python['bridge']}")
        return
    _print_folded("  ", f"where webots-mcp cannot be used: {python['error']}")


def doctor(
    *,
    no_server: Annotated[
        bool, Parameter("--no-server", help="Skip the check that starts an MCP server.")
    ] = False,
    as_json: Json = False,
    recorded: Where = HERE,
) -> int:
    """Check every step from controller to client, and show how to fix what is wrong.

    Changes nothing. Exit code 0: nothing is wrong; there may be warnings. 1: something is wrong.
    2: the checks could not run.
    """
    from webots_mcp.setup.doctor import all_checks, diagnose

    with shown_activity("checking"):
        checked = diagnose(_examined(recorded), all_checks(with_server=not no_server))
    if as_json:
        print_json({"checks": [_facts(each) for each in checked]})
    else:
        _print_checks(checked)
    return 1 if any(each.finding.verdict == "wrong" for each in checked) else 0


def _examined(recorded: Where) -> Examined:
    from dataclasses import replace

    from webots_mcp.database.location import choose_data_dir
    from webots_mcp.setup.doctor import subject_of

    try:
        recording = recorded.recording()
        named = recorded.database is not None
        rule = "--database" if named else choose_data_dir(recorded.data_dir).chosen_by
    except OSError as error:
        raise InvalidInputError(str(error)) from error
    return replace(subject_of(recording, rule), probes_python=True)


def _facts(checked: Checked) -> dict[str, Any]:
    check, finding = checked
    mend = {} if checked.is_well else {"fix": finding.fix, "page": check.page}
    return {"check": check.name, "verdict": finding.verdict, "seen": finding.seen, **mend}


def _print_checks(checked: list[Checked]) -> None:
    counts = Counter(each.finding.verdict for each in checked)
    wrong = counts["wrong"]
    problems = f"{wrong} problem{'s' * (wrong != 1)} found" if wrong else "No problem found"
    named = (
        f"{n} {verdict}{'s' * (verdict == 'warning' and n > 1)}" for verdict, n in counts.items()
    )
    print(f"{problems}: {', '.join(named)}.\n")
    for check, finding in checked:
        _print_folded(f"{finding.verdict:13}  {check.name:15}  ", finding.seen)
        if finding.fix:
            _print_folded(f"{'':30}  -> ", f"{finding.fix} ({check.page})")


def _print_folded(head: str, text: str) -> None:
    """Print a text after a heading; on a terminal, further lines are aligned with the first."""
    width = terminal_width(sys.stdout)
    lines = textwrap.wrap(
        printable(as_typed(text)),
        max(width - len(head), 30),
        break_long_words=False,
        break_on_hyphens=False,
    )
    print(head + f"\n{'':{len(head)}}".join(lines))


def header(
    target: Annotated[
        Path,
        Parameter(
            "TARGET", help="Folder of the controller, or the file to write. Default: webots_mcp.h."
        ),
    ] = Path(),
    /,
    *,
    as_json: Json = False,
) -> None:
    """Write webots_mcp.h, with which a controller in C or C++ records.

        webots-mcp header controllers/my_robot

    Replaces an older version of this file. 'webots-mcp help c' lists its functions.
    """
    from webots_mcp.contract import C_HEADER

    file = target / C_HEADER.name if target.is_dir() else target
    if not file.suffix.startswith(".h"):
        raise InvalidInputError(
            f"{target} is neither a folder nor a file named *.h. Name the controller's folder."
        )
    text = C_HEADER.read_text("utf-8")
    try:
        if file.exists() and not file.read_bytes().startswith(text[:15].encode()):
            raise InvalidInputError(f"{file} is another file and was not changed. Name a new file.")
        file.write_text(text, "utf-8", newline="\n")
    except OSError as error:
        raise InvalidInputError(f"{file} cannot be written: {error}") from error
    if as_json:
        return print_json({"file": str(file)})
    print(f'Wrote {file}. Next: #include "{file.name}" in the controller.')


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish", "powershell"] | None,
        Parameter("SHELL", help="Shell to complete in. Default: the one that runs this command."),
    ] = None,
    /,
    *,
    install: Annotated[
        bool,
        Parameter(
            "--install",
            negative=(),
            help="Install the script for all later sessions, in the folder of the shell.",
        ),
    ] = False,
    values: Annotated[
        Literal["robots", "runs", "signals", "kinds"] | None,
        Parameter("--values", help="List names from the recording instead, one per line."),
    ] = None,
    as_json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Print the script for Tab completion of commands, options, files and recorded names.

    For this session only:

        source <(webots-mcp completion bash)

    --install sets it up for all later sessions. Repeat that after an update of webots-mcp. Robots,
    runs, signals and kinds of events are completed in bash, zsh and fish.
    """
    from cyclopts.completion import detect_shell
    from cyclopts.completion.detect import ShellDetectionError

    from webots_mcp.cli import app_for
    from webots_mcp.cli.shell_completion import values_of, with_values

    if values is not None:
        names = values_of(values, recorded.recording())
        return print_json(names) if as_json else print(*map(printable, names), sep="\n")
    try:
        shell = shell or detect_shell()
    except ShellDetectionError as error:
        raise InvalidInputError("The shell is not known. Name it: bash, zsh or fish.") from error
    if shell == "powershell" and sys.version_info < (3, 11):  # unknown to cyclopts 4
        raise InvalidInputError("the script for PowerShell needs Python 3.11 or newer")
    app = app_for([], shows_all=True)
    if install:
        file = app.install_completion(shell=shell, add_to_startup=shell != "fish")
        file.write_text(with_values(file.read_text("utf-8"), shell), "utf-8", newline="\n")
        if as_json:
            return print_json({"shell": shell, "file": str(file)})
        print(f"{file} written. Start a new {shell} to use it.")
        start = Path.home() / ".zshrc"
        if shell == "zsh" and start.is_file() and "compinit" not in start.read_text("utf-8"):
            print("zsh completes nothing yet: add 'autoload -Uz compinit && compinit' to ~/.zshrc.")
        return None
    script = with_values(app.generate_completion(shell=shell), shell)
    if as_json:
        return print_json({"shell": shell, "script": script})
    print(script)
