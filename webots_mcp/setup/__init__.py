"""A Webots project: its folder, its controllers, the Python that Webots starts each with.

It is what `webots-mcp init` makes ready; a file of it is changed wholly or not at all.

Webots takes `[python] COMMAND` of the controller's `runtime.ini`, else the Python command of its
preferences; on Linux and macOS the controller's `#!` line goes before both.
"""

from __future__ import annotations

import contextlib
import difflib
import json
import os
import plistlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import (
    CONTROLLER_FOLDER,
    OBSERVER_NAME,
    PROJECT_IS,
    WORLD_ENDING,
    WORLD_FOLDER,
    find_project,
    full_path,
)
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.requirements import checkout, quoted
from webots_mcp.webots import installations

_PYTHON: Final = "Python"
_BRIDGE: Final = b"MCPBridge"
# Of a world file: strings and names; a comment is neither, and hides what is in it.
_WORDS: Final = re.compile(r'"(?:[^"\\]|\\.)*"|#[^\n]*|\w+')


# By language: how the files of a controller end that are built before Webots starts it.
_SOURCES: Final = {"C": (".c",), "C++": (".cpp", ".cc", ".cxx"), "Java": (".java",)}
_ALL_SOURCES: Final = (".c", ".cpp", ".cc", ".cxx", ".java", ".m", ".h", ".hpp", ".hh")
_WRITES: Final = re.compile(rb"webots_mcp\.h|setCustomData|wb_robot_set_custom_data")
_CALLS: Final = {
    "C": 'wb_robot_set_custom_data("{...}")',
    "C++": 'robot->setCustomData("{...}")',
    "Java": 'robot.setCustomData("{...}")',
    "MATLAB": "wb_robot_set_custom_data('{...}')",
}
_HEADER: Final = "include webots_mcp.h ('webots-mcp header' writes it), or "
_ONE_LINE: Final = (
    "write its values as JSON with {} in each step: an observer ('webots-mcp init --observer "
    "WORLD') records them; see docs/any-language.md"
)


NO_SUPERVISOR: Final = (
    "is a plain Robot: pause, step, reset, screenshots and the scene need a Supervisor"
)
NO_POSITION_OF_ITS_OWN: Final = (
    "Unless it publishes its position (pose, gps), stuck, distances and paths are not known"
)


class ProjectController(NamedTuple):
    """A controller's folder, the file of it that Webots starts, and what that is written in.

    Where the sources of a program are there, `file` is one of them.
    """

    name: str
    file: Path
    language: str
    is_built: bool = True

    @property
    def advice(self) -> str:
        """How it is recorded, where the bridge cannot be used in it."""
        header = _HEADER if self.language in ("C", "C++") else ""
        call = _CALLS.get(self.language, _CALLS["C"])
        return f"{header}{_ONE_LINE.format(call)}"

    @property
    def is_python(self) -> bool:
        """Whether the bridge can be used in it."""
        return self.language == _PYTHON


def project_of(folder: str | None) -> Path:
    """The project that a folder belongs to, or the current folder.

    Raises:
        InvalidInputError: There is no such folder, or it belongs to no project.
        OSError: The path cannot be followed.
    """
    start = full_path(folder or ".")
    if not start.is_dir():
        raise InvalidInputError(f"{start} is no folder: give that of a Webots project")
    if project := find_project(start):
        return project
    below = [each for each in sorted(start.iterdir()) if find_project(each) == each]
    hint = f" (one lies below: {below[0]})" if below else ""
    raise InvalidInputError(
        f"no Webots project at or above {start}: that is {PROJECT_IS}"
        f"{hint}; give its folder, as 'webots-mcp init PROJECT'"
    )


def controllers_of(project: Path, platform: str = sys.platform) -> list[ProjectController]:
    """Those that Webots would start, by name; none in a project of extern controllers alone."""
    folder = project / CONTROLLER_FOLDER
    folders = sorted(each for each in folder.glob("*") if each.is_dir())
    return [found for folder in folders for found in _started(folder, platform)]


def _started(folder: Path, platform: str) -> Iterator[ProjectController]:
    """The file of a controller's folder that Webots starts: the first that is there."""
    name = folder.name
    program = f"{name}.exe" if platform == "win32" else name
    kinds = {
        "Dockerfile": "a container" if platform == "linux" else None,
        program: "a program",
        f"build/release/{program}": "a program",
        f"{name}.class": "Java",
        f"{name}.jar": "Java",
        f"{name}.py": _PYTHON,
        f"{name}.m": "MATLAB",
    }
    found = next((each for each, kind in kinds.items() if kind and (folder / each).is_file()), None)
    source = _source(folder)
    if found is None and source is not None:
        yield source
    elif found is not None and source is not None and kinds[found] == "a program":
        yield source._replace(is_built=True)
    elif found is not None:
        yield ProjectController(name, folder / found, kinds[found] or "")
    elif (folder / "package.xml").is_file():
        yield ProjectController(name, folder / "package.xml", "ROS")


def _source(folder: Path) -> ProjectController | None:
    """What a controller is built from: the file of its name, else the first of a language."""
    files = [*sorted(folder.glob("*.*")), *sorted(folder.glob("src/*.*"))]
    files.sort(key=lambda file: file.stem != folder.name)
    for file in files:
        for language, endings in _SOURCES.items():
            if file.suffix in endings:
                return ProjectController(folder.name, file, language, is_built=False)
    return None


def has_bridge(controller: Path) -> bool:
    """Whether a file of a controller's folder speaks of the bridge."""
    return any(_BRIDGE in file.read_bytes() for file in sorted(controller.glob("*.py")))


def writes_states(controller: ProjectController) -> bool:
    """Whether a controller in another language says what it does: by our header, or customData."""
    folder = controller.file.parent
    files = [each for each in folder.rglob("*.*") if each.suffix in _ALL_SOURCES]
    return any(_WRITES.search(each.read_bytes()) for each in files)


def has_observer(project: Path) -> bool:
    """Whether the project has an observer's controller."""
    return (project / CONTROLLER_FOLDER / OBSERVER_NAME).is_dir()


def offer_observer(project: Path | None, world: Path | None = None) -> str:
    """The line that adds an observer to a world of a project, or to the only one that it has."""
    worlds = sorted((project / WORLD_FOLDER).glob(f"*{WORLD_ENDING}")) if project else []
    chosen_world = world or (worlds[0] if len(worlds) == 1 else None)
    name = "WORLD"
    if chosen_world is not None:
        inside = project is not None and chosen_world.is_relative_to(project)
        name = str(chosen_world.relative_to(project) if inside and project else chosen_world)
    return f"{quoted(['webots-mcp', 'init', '--observer', name])} adds a robot that has all of it"


def controllers_in(world: Path) -> list[str]:
    """The controllers that a world file names, each once; robots of PROTOs may have others.

    Raises:
        OSError: It cannot be read.
    """
    words = _WORDS.findall(world.read_text("utf-8", "replace"))
    named = (after[1:-1] for word, after in pairwise(words) if word == "controller")
    return list(dict.fromkeys(name for name in named if name))


def names_a_supervisor(world: Path) -> bool:
    """Whether a world file gives a robot the rights of a Supervisor.

    Raises:
        OSError: It cannot be read.
    """
    words = _WORDS.findall(world.read_text("utf-8", "replace"))
    return ("supervisor", "TRUE") in pairwise(words)


PROBE_TIMEOUT_S: Final = 30.0
_PREFERENCE: Final = "pythonCommand"
_SECTION: Final = re.compile(r"\s*\[(.*)\]\s*")
# For any Python 3. -B leaves no compiled files behind in a folder that is only looked at.
_PROBE: Final = """
import json, os, sys
said = {"executable": sys.executable, "python": "%d.%d.%d" % sys.version_info[:3]}
try:
    from webots_mcp import MCPBridge, __version__
    said["bridge"] = __version__
except Exception as error:
    said["error"] = "%s: %s" % (type(error).__name__, error)
    said["missing"] = isinstance(error, ImportError) and "webots_mcp" == getattr(error, "name", "")
    import importlib.util, sysconfig
    said["pip"] = importlib.util.find_spec("pip") is not None
    marker = os.path.join(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED")
    said["managed"] = sys.prefix == sys.base_prefix and os.path.exists(marker)
print()
print(json.dumps(said))
"""


class Chosen(NamedTuple):
    """The command with which Webots starts a controller.

    Attributes:
        command: The program and its first arguments.
        by: What says so.
    """

    command: tuple[str, ...]
    by: str


@dataclass(frozen=True)
class Interpreter:
    """What was found out about the Python of a controller.

    Attributes:
        command: As Webots has it.
        chosen_by: What says so: a file, or Webots' default.
        executable: Its program; None where it could not be started.
        python: Its version.
        bridge: The version of webots-mcp that a controller imports there; None if it cannot.
        error: Why the bridge cannot be imported.
        fix: What mends it, to be typed in a shell or done.
    """

    command: str
    chosen_by: str
    executable: str | None = None
    python: str | None = None
    bridge: str | None = None
    error: str | None = None
    fix: str | None = None


def chosen(controller: Path, platform: str = sys.platform) -> Chosen:
    """The command for a controller's file, by Webots' rules for that system."""
    if platform != "win32" and (line := _first_line(controller)).startswith("#!"):
        return Chosen(tuple(line[2:].split()), f"the #! line of {controller.name}")
    if command := _runtime_command(controller.with_name("runtime.ini")):
        return Chosen((command,), f"{controller.parent.name}/runtime.ini")
    if found := _preferred(platform):
        return found
    default = "python" if platform == "win32" else "python3"
    return Chosen((default,), "Webots' default, as no preferences were found")


def _first_line(file: Path) -> str:
    with file.open("rb") as source:
        return source.readline().decode("utf-8", "replace").strip()


def _runtime_command(file: Path) -> str | None:
    """`COMMAND` of its section `[python]`."""
    try:
        text = file.read_text("utf-8-sig", "replace")
    except FileNotFoundError:
        return None
    return _ini_value(text, ("python",), "COMMAND")


def _ini_value(text: str, sections: tuple[str, ...], key: str) -> str | None:
    section = ""
    for line in text.splitlines():
        if found := _SECTION.fullmatch(line.partition(";")[0]):
            section = found[1].strip()
            continue
        name, _, value = line.partition("=")
        if section.lower() in sections and name.strip() == key:
            return value.strip().strip('"') or None
    return None


def _preferred(platform: str) -> Chosen | None:
    """The Python command of Webots' preferences: of the version that is used, else the newest."""
    known = _preferences(platform)
    versions = [found.version.split()[0] for found in installations(platform) if found.version]
    for version in [*versions, *sorted(known, reverse=True)]:
        if command := known.get(version):
            return Chosen((command,), f"the preferences of Webots {version}")
    return None


def _preferences(platform: str) -> dict[str, str]:
    """The Python command by version of Webots, as far as one is set."""
    if platform == "win32":
        return _of_registry()
    if platform == "darwin":
        files = (Path.home() / "Library/Preferences").glob("com.cyberbotics.Webots-R*.plist")
        read = _of_plist
    else:
        folder = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
        files, read = (folder / "Cyberbotics").glob("Webots-R*.conf"), _of_conf
    found = {file.stem.partition("Webots-")[2]: read(file) for file in files}
    return {version: command for version, command in found.items() if command}


def _of_conf(file: Path) -> str | None:
    # Qt writes a group that is named General as [%General]; [General] holds what has no group.
    text = file.read_text("utf-8", "replace")
    return _ini_value(text, ("%general",), _PREFERENCE)


def _of_plist(file: Path) -> str | None:
    try:
        values: Any = plistlib.loads(file.read_bytes())
    except (plistlib.InvalidFileException, ValueError):
        return None
    if not isinstance(values, dict):
        return None
    return str(cast("dict[str, Any]", values).get(f"General.{_PREFERENCE}") or "") or None


def _of_registry() -> dict[str, str]:
    if sys.platform != "win32":
        return {}
    import winreg

    found: dict[str, str] = {}
    try:
        root = winreg.OpenKey(winreg.HKEY_CURRENT_USER, r"Software\Cyberbotics")
    except FileNotFoundError:
        return found
    with root:
        for index in range(winreg.QueryInfoKey(root)[0]):
            name = winreg.EnumKey(root, index)
            try:
                with winreg.OpenKey(root, rf"{name}\General") as key:
                    value, _ = winreg.QueryValueEx(key, _PREFERENCE)
            except FileNotFoundError:
                continue
            if name.startswith("Webots-R") and value:
                found[name.removeprefix("Webots-")] = str(value)
    return found


def look_into(controller: Path, timeout_s: float = PROBE_TIMEOUT_S) -> Interpreter:
    """Start the Python of a controller as Webots would, and import the bridge there."""
    by_rule = chosen(controller)
    settings = {"command": " ".join(by_rule.command), "chosen_by": by_rule.by}
    line = [*by_rule.command, "-B", "-c", _PROBE]
    program = shutil.which(line[0], path=_desktop_path())
    if program is None:
        return Interpreter(
            **settings,
            error=f"there is no program {line[0]!r}",
            fix="set the right one in Webots (Preferences, General, Python command)"
            if "preferences" in by_rule.by or "default" in by_rule.by
            else f"correct it in {by_rule.by}",
        )
    try:
        ended = subprocess.run(
            [program, *line[1:]], cwd=controller.parent, timeout=timeout_s, check=False,
            capture_output=True, stdin=subprocess.DEVNULL, env=_environment(),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return Interpreter(**settings, error=f"it did not end within {timeout_s:g} s", fix=_BY_HAND)
    except OSError as error:
        return Interpreter(**settings, error=f"it cannot be started: {error}", fix=_BY_HAND)
    return _judge(settings, ended)


_BY_HAND: Final = "start it in a terminal, or choose another in Webots' preferences"


def _judge(settings: dict[str, str], ended: subprocess.CompletedProcess[bytes]) -> Interpreter:
    lines = ended.stdout.decode("utf-8", "replace").strip().splitlines() or [""]
    try:
        said: dict[str, Any] = json.loads(lines[-1])
        executable, python = str(said["executable"]), str(said["python"])
    except (ValueError, KeyError, TypeError):
        last = (ended.stderr.decode("utf-8", "replace").strip().splitlines() or ["nothing"])[-1]
        why = f"it is no Python that works: exit code {ended.returncode}, {last:.200}"
        return Interpreter(**settings, error=why, fix=_BY_HAND)
    error = said.get("error")
    fix = _fix(said) if error else None
    return Interpreter(**settings, executable=executable, python=python, bridge=said.get("bridge"),
                       error=error, fix=fix)  # fmt: skip


def _fix(said: dict[str, Any]) -> str:
    version = tuple(map(int, said["python"].split(".")))
    if version < (3, 10):
        return (
            f"Python {said['python']} is too old, 3.10 or newer is needed: choose another in "
            "Webots (Preferences, General, Python command)"
        )
    options = ["--user", "--break-system-packages"] if said["managed"] else []
    command = [said["executable"], "-m", "pip", "install", *options, "--no-deps", checkout()]
    line = quoted(command)
    return line if said["pip"] else f"{line}   (it has no pip yet: {_how_to_get_pip(said)})"


def _how_to_get_pip(said: dict[str, Any]) -> str:
    if said["managed"]:
        return "install it with the system's packages, as 'apt install python3-pip'"
    return quoted([said["executable"], "-m", "ensurepip"])


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONIOENCODING": "UTF-8", "PATH": _desktop_path()}


def _desktop_path() -> str:
    """The PATH without the virtual environment of this shell.

    Webots that was started from the desktop knows nothing of it.
    """
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    roots = [Path(root) for root in (os.environ.get("VIRTUAL_ENV"), _own_environment()) if root]
    hidden = {root / part for root in roots for part in ("bin", "Scripts")}
    return os.pathsep.join(folder for folder in folders if Path(folder) not in hidden)


def _own_environment() -> str | None:
    return sys.prefix if sys.prefix != sys.base_prefix else None


class FileChange(NamedTuple):
    """What a file is to hold.

    Attributes:
        file: As it was named; a symbolic link is followed when it is written.
        before: What it holds; None where there is no such file.
        after: What it is to hold.
    """

    file: Path
    before: bytes | None
    after: bytes

    @property
    def is_needed(self) -> bool:
        """Whether the file differs from what it is to hold."""
        return self.before != self.after

    @property
    def diff(self) -> str:
        """The lines that change, whatever the file's encoding."""
        before, after = (
            (content or b"").decode("utf-8", "replace").splitlines()
            for content in (self.before, self.after)
        )
        names = str(self.file), f"{self.file} (new)"
        return "\n".join(difflib.unified_diff(before, after, *names, lineterm="", n=2))


def read(file: Path) -> bytes | None:
    """What the file holds; None where there is none.

    Raises:
        OSError: It cannot be read, or is no file.
    """
    try:
        return file.read_bytes()
    except FileNotFoundError:
        for each in (file, file.parent):
            if each.is_symlink() and not each.exists():
                raise OSError(f"{each} is a symbolic link to nothing: remove or mend it") from None
        return None


def apply(change: FileChange) -> None:
    """Write the file, by a new one that takes its place; its permissions stay.

    Raises:
        CommandRefusedError: It may not be written, or has changed since it was read.
        OSError: It cannot be written.
    """
    target = change.file.resolve()
    if change.before is not None and not os.access(target, os.W_OK):
        raise CommandRefusedError(f"{change.file} is read-only: make it writable first")
    if read(change.file) != change.before:
        raise CommandRefusedError(f"{change.file} has changed meanwhile: try again")
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f".{target.name}.{os.getpid()}.new")
    try:
        with aside.open("xb") as new:
            new.write(change.after)
            new.flush()
            os.fsync(new.fileno())
        if change.before is not None:
            aside.chmod(target.stat().st_mode & 0o7777)
        os.replace(aside, target)  # noqa: PTH105
    finally:
        with contextlib.suppress(FileNotFoundError):
            aside.unlink()
