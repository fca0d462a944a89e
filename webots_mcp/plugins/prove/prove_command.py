"""The command that tries on a real Webots what is known of it from its sources alone."""

from __future__ import annotations

import getpass
import inspect
import os
import platform
import queue
import re
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from webots_mcp.cli.options import Json, Parameter
from webots_mcp.cli.terminal import print_json, printable
from webots_mcp.errors import CommandRefusedError, InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.plugins.prove.bench import Bench

_LIMIT_S: Final = 300.0  # of a check, beside a start
_LONGEST: Final = 500
_SAID: Final = ("expected", "seen", "works still")
_OUTCOMES: Final = ("as expected", "otherwise", "not tried")


def prove(
    *,
    webots: Annotated[
        Path | None,
        Parameter("--webots", metavar="PATH", help="Its folder or program; else as launch finds."),
    ] = None,
    only: Annotated[
        list[str] | None,
        Parameter("--only", metavar="CHECK", help="Only this check; may be repeated."),
    ] = None,
    patience_s: Annotated[
        float, Parameter("--patience", help="Seconds from a start to the first row, at most (60).")
    ] = 60.0,
    as_json: Json = False,
) -> int:
    """Try on the Webots of this machine what we know of it from its sources alone.

    Starts it a few times without its window, on a world of its own in a temporary folder, and says
    of each statement of docs/webots.md whether it is so. This takes some minutes. What --json
    prints names no file, user or machine: please send it with an issue. The exit code is 1 if
    anything is otherwise.
    """
    from webots_mcp import __version__
    from webots_mcp.plugins.prove.bench import Bench
    from webots_mcp.plugins.prove.checks import CHECKS, NOT_TRIED
    from webots_mcp.webots import find_webots
    from webots_mcp.webots.starting import Start

    for name in only or ():
        if name not in CHECKS:
            raise InvalidInputError(f"--only {name!r} is none of {', '.join(CHECKS)}")
    if webots is not None:
        _choose(webots)
    for name in [each for each in os.environ if each.startswith("WEBOTS_MCP_")]:
        del os.environ[name]  # what would change how its controllers record
    Start(Path(), None, headless=True, streams=False, port=0).command_line()  # there is one
    found = list[dict[str, Any]]()

    def tell(each: dict[str, Any]) -> None:
        found.append(each)
        parts = [f"{each['check']}: {each['outcome']}"]
        parts += [f"{name}: {each[name]}" for name in _SAID if each.get(name)]
        print(printable("; ".join(parts)), file=sys.stderr if as_json else sys.stdout, flush=True)

    with tempfile.TemporaryDirectory(prefix="webots-mcp-", ignore_cleanup_errors=True) as folder:
        hidden = _hidden(folder)
        bench = Bench(Path(folder) / "project", patience_s)
        try:
            for name in only or CHECKS:
                tell({"check": name, **tried(CHECKS[name], bench, hidden)})
        finally:
            bench.end()
    for name, why in NOT_TRIED.items() if only is None else ():
        tell({"check": name, "outcome": "not tried", "seen": why})
    counts = {each: sum(one["outcome"] == each for one in found) for each in _OUTCOMES}
    if as_json:
        versions = {"webots": find_webots().version, "webots_mcp": __version__}
        system = {"system": _system(), "machine": platform.machine()}
        print_json({**versions, **system, "python": platform.python_version(), "counts": counts,
                    "checks": found})  # fmt: skip
    else:
        print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    return int(counts["otherwise"] > 0)


def _choose(path: Path) -> None:
    """Let that Webots be the one that is found.

    Raises:
        CommandRefusedError: There is none.
    """
    from webots_mcp.webots import HOME_VARIABLE, installations

    path = path.resolve()
    os.environ.pop(HOME_VARIABLE, None)
    if path.is_dir():
        os.environ[HOME_VARIABLE] = str(path)
    else:
        os.environ["PATH"] = os.pathsep.join((str(path.parent), os.environ.get("PATH", "")))
    for first in installations()[:1]:
        if path in (first.home, first.program, first.program.resolve()):
            return
    raise CommandRefusedError(f"{path} is neither the folder nor the program of a Webots")


def tried(
    check: Callable[[Bench], object],
    bench: Bench,
    hidden: Mapping[str, str],
    limit_s: float = _LIMIT_S,
) -> dict[str, Any]:
    """What came of a check: where it hangs, Webots is ended and its thread left alone.

    Args:
        check: One of `checks.CHECKS`.
        bench: Its Webots.
        hidden: What no text may name, the longest first, and what stands there instead.
        limit_s: In so much time it is over, besides that of a start.
    """
    from webots_mcp.plugins.prove.bench import NotTriedError

    came = queue.SimpleQueue[tuple[str, object]]()
    kind = check.__name__.partition("_")[0]

    def work() -> None:
        try:
            if kind != "check":
                bench.running(stream=kind == "streaming")
            came.put(("as expected", check(bench)))
        except NotTriedError as error:
            came.put(("not tried", error))
        except Exception as error:  # noqa: BLE001 - what an unknown Webots answers can be anything
            came.put(("otherwise", str(error) or type(error).__name__))

    began_s = time.monotonic()
    bench.user = threading.Thread(target=work, daemon=True)
    bench.user.start()
    try:
        outcome, seen = came.get(timeout=limit_s + bench.patience_s)
    except queue.Empty:
        outcome, seen = "otherwise", f"it hung for {limit_s:g} s"
        bench.end()
    text = None if seen is None else str(seen)[: 2 * _LONGEST]
    for name, shown in hidden.items():
        text = text and re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", lambda _, by=shown: by, text)
    expected, _, then = (inspect.getdoc(check) or "").rstrip(".").partition("; otherwise ")
    answer = {"outcome": outcome, "seen": text and text[:_LONGEST]}
    if outcome == "otherwise":
        answer |= {"expected": expected, "works still": then}
    return answer | {"took_s": round(time.monotonic() - began_s, 1)}


def _system() -> str:
    """Without the name of a kernel, which may be that of a machine."""
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        return f"{platform.system()} {platform.release()}"


def _hidden(folder: str) -> dict[str, str]:
    from webots_mcp.contract import host_name
    from webots_mcp.webots import find_webots

    found = find_webots()
    places = {folder: "FOLDER", str(Path(folder).resolve()): "FOLDER", sys.executable: "PYTHON"}
    places |= {str(each): "WEBOTS" for each in (found.program, found.home) if each}
    places |= {sys.prefix: "PYTHON", str(Path(__file__).parents[2]): "PACKAGE"}
    places |= {str(Path.home()): "~", host_name(): "HOST", getpass.getuser(): "USER"}
    return dict(sorted(places.items(), key=lambda each: -len(each[0])))
