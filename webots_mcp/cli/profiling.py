"""`webots-mcp profile`: the lines that take a controller's time, as py-spy samples them."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Final

from webots_mcp.cli.options import HERE, Count, Json, Parameter, Where
from webots_mcp.cli.terminal import print_json, print_table
from webots_mcp.contract import find_project, host_name
from webots_mcp.errors import CommandRefusedError
from webots_mcp.requirements import explain_extra
from webots_mcp.stacks import INSTALLED, STEPPING

_FRAME: Final = re.compile(r"(.*) \((.*):(\d+)\)$")
_OURS: Final = str(Path(__file__).parents[1])
_SHOWN: Final = 12
_WAITING: Final = ("waiting in step()", None)
_BRIDGE: Final = ("in the bridge", None)
_OTHER: Final = ("in no file of the controller", None)
_NOT_PERMITTED: Final = (
    "py-spy may not look into process {}: allow it with 'sudo sysctl kernel.yama.ptrace_scope=0' "
    "on Linux, with --cap-add SYS_PTRACE for a container, or ask as root (macOS)"
)


def profile(
    robot: Annotated[str | None, Parameter("ROBOT", help="Which (the only live one).")] = None,
    /,
    *,
    seconds: Annotated[Count, Parameter("--for", help="Seconds of wall time (10).")] = 10,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Sample which lines of a controller take its time, 100 times a second, by py-spy.

    Of the lines of its own files those that the main thread was in, or in what they called; time in
    which it sleeps or waits counts. Each sample stops the controller for about a millisecond.
    """
    with recorded.recording().view(robot) as view:
        name, session = view.robot.name, view.session
    if session is None or not view.robot.live or session.host != host_name():
        raise CommandRefusedError(f"no controller of {name} runs on this machine")
    if not session.has_bridge:
        raise CommandRefusedError(f"{name} has no bridge in Python: its lines cannot be sampled")
    controller = Path(session.controller or "/nowhere")
    own = str(find_project(controller.parent) or controller.parent)
    samples = Counter[tuple[str, str | None]]()
    for stack, count in _sampled(session.pid, seconds):
        samples[_place_of(stack, own)] += count
    total = samples.total()
    columns = ("share", "line", "function", "samples")
    rows = [[f"{n / total:.1%}", *place, n] for place, n in samples.most_common(_SHOWN)]
    if json:
        found = {"robot": name, "seconds": seconds, "samples": total}
        return print_json(found | {"columns": columns, "rows": rows})
    print_table(columns, rows)
    print(f"{name}: {total} samples of its main thread in {seconds} s")


def _sampled(pid: int, seconds: int) -> list[tuple[str, int]]:
    """The stacks of the main thread, and how often each was met.

    Raises:
        CommandRefusedError: py-spy is not installed, or not permitted; the text says what to do.
    """
    spy = shutil.which("py-spy") or shutil.which(Path(sys.executable).with_name("py-spy"))
    if spy is None:
        raise CommandRefusedError(explain_extra("webots-mcp profile", "profile"))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stacks"
        how = ("--format=raw", "--idle", "--threads", "--full-filenames", f"--output={file}")
        line = [spy, "record", f"--pid={pid}", f"--duration={seconds}", *how]
        ended = subprocess.run(line, capture_output=True, text=True, check=False)
        text = file.read_text("utf-8", "replace") if file.exists() else ""
    found = [line.rpartition(" ") for line in text.splitlines() if "MainThread;" in line]
    if found:
        return [(stack, int(count)) for stack, _, count in found]
    if re.search("permi", ended.stderr, re.IGNORECASE):
        raise CommandRefusedError(_NOT_PERMITTED.format(pid))
    *_, said = ended.stderr.strip().splitlines() or ["it has written nothing"]
    raise CommandRefusedError(f"py-spy could not sample process {pid}: {said}")


def _place_of(stack: str, own: str) -> tuple[str, str | None]:
    """The innermost line of the controller's own files, and its function."""
    in_bridge = False
    for each in reversed(stack.split(";")):
        function, file, line = found.groups() if (found := _FRAME.match(each)) else ("", "", "")
        is_own = file.startswith(own) and not INSTALLED.search(file)
        if function.rpartition(".")[2] in STEPPING and not is_own:
            return _WAITING
        if is_own:
            return _BRIDGE if in_bridge else (f"{Path(file).name}:{line}", f"{function}()")
        in_bridge = in_bridge or file.startswith(_OURS)
    return _OTHER
