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

from cyclopts.validators import Number

from webots_mcp.cli.options import HERE, Json, Parameter, Where, whole_number
from webots_mcp.cli.terminal import print_json, print_table
from webots_mcp.contract import find_project, host_name
from webots_mcp.errors import CommandRefusedError
from webots_mcp.requirements import explain_extra
from webots_mcp.stacks import INSTALLED, STEPPING

_FRAME: Final = re.compile(r"(.*) \((.*):(\d+)\)$")
_OURS: Final = str(Path(__file__).parents[1])
_SHOWN: Final = 10
_WAITING, _BRIDGE, _OTHER = "waiting in step()", "in the bridge", "elsewhere"
_NOT_PERMITTED: Final = (
    "the system does not let py-spy look into process {}: on Linux 'sudo sysctl "
    "kernel.yama.ptrace_scope=0' or, in a container, --cap-add SYS_PTRACE allows it; on macOS only "
    "root may"
)


def profile(
    robot: Annotated[str | None, Parameter("ROBOT", help="Which (the only live one).")] = None,
    /,
    *,
    seconds: Annotated[
        int,
        Parameter(
            "--for",
            help="Seconds of wall time (10).",
            converter=whole_number,
            validator=Number(gte=1, lte=3600),
        ),
    ] = 10,
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
    controller = Path(session.controller or "/nowhere")
    own = str(find_project(controller.parent) or controller.parent)
    samples = Counter[tuple[str, str]]()
    for stack, count in _sampled(session.pid, seconds):
        samples[_place_of(stack, own)] += count
    total = samples.total()
    shares = {each: samples.pop((each, ""), 0) / total for each in (_WAITING, _BRIDGE, _OTHER)}
    columns = ("share", "line", "function", "samples")
    rows = [[round(n / total, 3), *place, n] for place, n in samples.most_common(_SHOWN)]
    if json:
        shown = {"robot": name, "samples": total, "seconds": seconds, "columns": columns}
        return print_json(shown | {"rows": rows, "besides": shares})
    print_table(columns, [[f"{row[0]:.1%}", *row[1:]] for row in rows])
    rest = ", ".join(f"{share:.1%} {where}" for where, share in shares.items())
    print(f"{name}: {total} samples in {seconds} s of its main thread; besides {rest}")


def _sampled(pid: int, seconds: int) -> list[tuple[str, int]]:
    """The stacks of the main thread, and how often each was met.

    Raises:
        CommandRefusedError: py-spy is not installed, or not permitted; the text says what to do.
    """
    beside = Path(sys.executable).with_name("py-spy")
    spy = shutil.which("py-spy") or shutil.which(beside)
    if spy is None:
        raise CommandRefusedError(explain_extra("webots-mcp profile", "profile"))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stacks"
        how = ("--format=raw", "--idle", "--threads", "--full-filenames", f"--output={file}")
        line = [spy, "record", f"--pid={pid}", f"--duration={seconds}", *how]
        ended = subprocess.run(line, capture_output=True, text=True, check=False)
        text = file.read_text("utf-8", "replace") if file.exists() else ""
    found = [(stack, int(n)) for stack, _, n in (e.rpartition(" ") for e in text.splitlines())]
    found = [(stack, count) for stack, count in found if "MainThread;" in stack]
    if not found:
        why = _NOT_PERMITTED.format(pid) if re.search("(?i)permi", ended.stderr) else ""
        said = ended.stderr.strip().splitlines() or ["nothing was sampled"]
        raise CommandRefusedError(why or f"py-spy could not sample process {pid}: {said[-1]}")
    return found


def _place_of(stack: str, own: str) -> tuple[str, str]:
    """The innermost line of the controller's own files, and its function."""
    frames = [found.groups() for each in stack.split(";") if (found := _FRAME.match(each))]
    inner = list[str]()
    for function, file, line in reversed(frames):
        if function.rpartition(".")[2] in STEPPING and not file.startswith(own):
            return _WAITING, ""
        if file.startswith(own) and not INSTALLED.search(file):
            return (_BRIDGE, "") if inner else (f"{Path(file).name}:{line}", f"{function}()")
        inner += [file] if file.startswith(_OURS) else []
    return _OTHER, ""
