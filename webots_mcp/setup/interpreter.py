"""The Python that Webots starts a controller with, and whether the bridge can be imported there.

Webots takes `[python] COMMAND` of the controller's `runtime.ini`, else the Python command of its
preferences; on Linux and macOS the controller's `#!` line goes before both.
"""

from __future__ import annotations

import json
import os
import plistlib
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.extras.requirements import checkout, quoted
from webots_mcp.simulator.installations import installations

PROBE_TIMEOUT_S: Final = 30.0
_PREFERENCE: Final = "pythonCommand"
# For any Python 3. -B leaves no compiled files behind in a folder that is only read.
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
_BY_HAND: Final = "start it in a terminal, or choose another in Webots' preferences"


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
        fix: How to fix it: a command to type, or something to do.
    """

    command: str
    chosen_by: str
    executable: str | None = None
    python: str | None = None
    bridge: str | None = None
    error: str | None = None
    fix: str | None = None


def chosen(controller: Path, platform: str = sys.platform) -> Chosen:
    """Return the command for a controller's file, by Webots' rules for that system."""
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
        if found := re.fullmatch(r"\s*\[(.*)\]\s*", line.partition(";")[0]):
            section = found[1].strip()
            continue
        name, _, value = line.partition("=")
        if section.lower() in sections and name.strip() == key:
            return value.strip().strip('"') or None
    return None


def _preferred(platform: str) -> Chosen | None:
    """Return the Python command of the preferences of the used Webots, else of the newest."""
    known = _preferences(platform)
    versions = [found.version.split()[0] for found in installations(platform) if found.version]
    for version in [*versions, *sorted(known, reverse=True)]:
        if command := known.get(version):
            return Chosen((command,), f"the preferences of Webots {version}")
    return None


def _preferences(platform: str) -> dict[str, str]:
    """Return the Python command by version of Webots, as far as one is set."""
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


def probe_interpreter(controller: Path, timeout_s: float = PROBE_TIMEOUT_S) -> Interpreter:
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
    """Return the PATH without the virtual environment of this shell.

    Webots that was started from the desktop knows nothing of it.
    """
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    roots = [Path(root) for root in (os.environ.get("VIRTUAL_ENV"), _own_environment()) if root]
    hidden = {root / part for root in roots for part in ("bin", "Scripts")}
    return os.pathsep.join(folder for folder in folders if Path(folder) not in hidden)


def _own_environment() -> str | None:
    return sys.prefix if sys.prefix != sys.base_prefix else None
