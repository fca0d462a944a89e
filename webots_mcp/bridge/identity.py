"""The identity of a recording process: robot, process, code. What is missing raises no error."""

from __future__ import annotations

import os
import sqlite3
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import host_name
from webots_mcp.liveness import process_identity

_THIS_HOST: Final = ("", "localhost", "127.0.0.1", "::1", host_name().lower())


class Identity(NamedTuple):
    """The facts about a controller process when its bridge starts."""

    robot_name: str
    kind: str
    supervisor: bool
    devices: dict[str, str]
    world: str | None
    basic_time_step_ms: float | None
    pid: int
    process: str | None
    host: str
    instance: str
    extern: bool
    controller: str | None
    controller_sha256: str | None
    git_commit: str | None
    versions: dict[str, str]
    throttle_interval: int


def identify(
    robot: Any, supervisor: bool, version: str, throttle_interval: int, kind: str | None = None
) -> Identity:
    """Collect the identity; what cannot be determined is None, never an error."""
    controller = controller_file()
    return Identity(
        robot_name=str(robot.getName() or os.environ.get("WEBOTS_ROBOT_NAME") or "robot"),
        kind=kind or ("Supervisor" if supervisor else "Robot"),
        supervisor=supervisor,
        devices={str(name): type(device).__name__ for name, device in _devices(robot).items()},
        world=_plain_text(robot.getWorldPath()) if hasattr(robot, "getWorldPath") else None,
        basic_time_step_ms=float(robot.getBasicTimeStep()),
        pid=os.getpid(),
        process=process_identity(os.getpid()),
        host=host_name(),
        instance=_instance(),
        extern=_is_extern(),
        controller=_plain_text(controller) if controller else None,
        controller_sha256=_sha256(controller) if controller else None,
        git_commit=_git_commit(controller.parent) if controller else None,
        versions={
            "python": sys.version.split()[0],
            "webots_mcp": version,
            "sqlite": sqlite3.sqlite_version,
        },
        throttle_interval=throttle_interval,
    )


def controller_file() -> Path | None:
    """The file of the main program; None where there is none, as at a prompt."""
    main = getattr(sys.modules.get("__main__"), "__file__", None) or sys.argv[0]
    path = Path(main).absolute() if main else None
    return path if path and path.is_file() else None


def _plain_text(path: object) -> str:
    """A path as valid text: file names may have any bytes, the database needs UTF-8."""
    return str(path).encode("utf-8", "replace").decode()


def _devices(robot: Any) -> dict[str, Any]:
    return getattr(robot, "devices", None) or {}


def _instance() -> str:
    """Identifies the Webots: its host and port, or else the process that started this one."""
    folder = os.environ.get("WEBOTS_INSTANCE_PATH", "").rstrip("/\\")
    url = os.environ.get("WEBOTS_CONTROLLER_URL", "")
    if folder and not _is_extern():
        port = folder[len(folder.rstrip("0123456789")) :]  # /tmp/webots/ada/1234, ...\webots-1234
        return f"{host_name()}:{port}" if port else f"{host_name()}:{folder}"
    if "://" in url:
        return _simulator_of(url)
    return f"{host_name()} process {os.getppid()}"


def _simulator_of(url: str) -> str:
    """Of `ipc://1234/robot` or `tcp://192.168.1.5:1234/robot`; the robot may be left out."""
    place = url.partition("://")[2].partition("/")[0]
    host, _, port = place.rpartition(":")
    return f"{host_name() if host.strip('[]').lower() in _THIS_HOST else host}:{port}"


def _is_extern() -> bool:
    """Whether Webots did not start this process, and so will not start its successor.

    The variables are tested in the order in which Webots' library reads them.
    """
    intern = "WEBOTS_ROBOT_NAME" in os.environ and "WEBOTS_INSTANCE_PATH" in os.environ
    return not intern and "WEBOTS_CONTROLLER_URL" in os.environ


def _sha256(file: Path) -> str | None:
    try:
        return _sha256_of(file.read_bytes())
    except OSError:
        return None


def _sha256_of(data: bytes) -> str:
    """By the interpreter's own module: hashlib would load OpenSSL, for 5 ms and 4 MB more."""
    for name in ("_sha2", "_sha256"):  # since Python 3.12, and before it
        try:
            return __import__(name).sha256(data).hexdigest()
        except ImportError:  # noqa: PERF203
            continue
    import hashlib

    return hashlib.sha256(data).hexdigest()


def _git_commit(folder: Path) -> str | None:
    """The commit that is checked out, read from git's files: no child process in a controller."""
    try:
        for place in (folder, *folder.parents):
            if (place / ".git").exists():
                return _head(_git_dir(place / ".git"))
    except (OSError, ValueError):  # unreadable, or not text
        return None
    return None


def _git_dir(git: Path) -> Path:
    """In a worktree or submodule `.git` is a file that names the folder."""
    if git.is_dir():
        return git
    return (git.parent / git.read_text("utf-8").partition("gitdir:")[2].strip()).resolve()


def _head(git: Path) -> str | None:
    head = (git / "HEAD").read_text("utf-8").strip()
    if not head.startswith("ref:"):
        return head
    ref = head[4:].strip()
    common = git / "commondir"
    base = (git / common.read_text("utf-8").strip()).resolve() if common.exists() else git
    if (base / ref).exists():
        return (base / ref).read_text("utf-8").strip()
    packed = base / "packed-refs"
    lines = packed.read_text("utf-8").splitlines() if packed.exists() else []
    return next((line.split()[0] for line in lines if line.endswith(f" {ref}")), None)
