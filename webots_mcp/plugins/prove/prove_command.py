"""The command that tries on a real Webots what is known of it from its sources alone."""

from __future__ import annotations

import getpass
import os
import platform
import queue
import re
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from webots_mcp.cli.options import Json, Parameter
from webots_mcp.cli.terminal import print_json, printable
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError

if TYPE_CHECKING:
    from webots_mcp.plugins.prove.bench import Bench
    from webots_mcp.plugins.prove.checks import Check

Outcome = Literal["as expected", "otherwise", "not tried"]
_LONGEST: Final = 500


@dataclass(frozen=True)
class Finding:
    """What came of a check.

    Attributes:
        check: Its name.
        outcome: As expected, otherwise, or not tried.
        expected: What the sources say.
        seen: What was measured, what was seen instead, or why it was not tried.
        works_still: Where it is otherwise.
        took_s: Wall time.
    """

    check: str
    outcome: Outcome
    expected: str | None
    seen: str | None
    works_still: str | None
    took_s: float


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
        float,
        Parameter("--patience", help="Seconds that a start may take until the first row (60)."),
    ] = 60.0,
    as_json: Json = False,
) -> int:
    """Try on the Webots of this machine what we know of it from its sources alone.

    Starts it a few times without its window, on a world of its own in a temporary folder, and says
    of each statement of docs/webots.md whether it is so. This takes some minutes. What --json
    prints names no file, user or machine: please send it with an issue. The exit code is 1 if
    anything is otherwise.
    """
    from webots_mcp.plugins.prove.bench import Bench
    from webots_mcp.plugins.prove.checks import CHECKS, NOT_TRIED
    from webots_mcp.webots import find_webots
    from webots_mcp.webots.starting import Start, free_port

    if webots is not None:
        _choose(webots)
    wanted = [each for each in CHECKS if only is None or each.name in only]
    if only and (unknown := set(only) - {each.name for each in CHECKS}):
        names = ", ".join(each.name for each in CHECKS)
        raise InvalidInputError(f"--only {unknown.pop()!r}: there is {names}")
    stream = sys.stderr if as_json else sys.stdout
    findings = list[Finding]()
    with tempfile.TemporaryDirectory(prefix="webots-mcp-", ignore_cleanup_errors=True) as folder:
        hidden = _hidden(Path(folder))
        Start(Path(folder), None, headless=True, streams=False, port=free_port()).command_line()
        bench = Bench(Path(folder) / "project", patience_s)
        try:
            for check in wanted:
                found = _try(check, bench, hidden)
                findings.append(found)
                print(_line(found), file=stream, flush=True)
        finally:
            bench.end()
    for name, why in NOT_TRIED.items() if only is None else ():
        findings.append(Finding(name, "not tried", None, why, None, 0.0))
        print(_line(findings[-1]), file=stream)
    counts = {each: sum(f.outcome == each for f in findings) for each in Outcome.__args__}
    if as_json:
        print_json(
            {"webots": find_webots().version, **_versions(), **counts,
             "checks": [asdict(each) for each in findings]}
        )  # fmt: skip
    else:
        print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    return 1 if counts["otherwise"] else 0


def _choose(path: Path) -> None:
    """Let that Webots be the one that is found.

    Raises:
        CommandRefusedError: There is none.
    """
    from webots_mcp.webots import HOME_VARIABLE, installations

    if path.is_file():
        os.environ["PATH"] = f"{path.resolve().parent}{os.pathsep}{os.environ['PATH']}"
        os.environ.pop(HOME_VARIABLE, None)
    else:
        os.environ[HOME_VARIABLE] = str(path.resolve())
    first = next(iter(installations()), None)
    if first is None or path.resolve() not in (first.home, first.program, first.program.resolve()):
        raise CommandRefusedError(f"{path} is neither the folder nor the program of a Webots")


def _try(check: Check, bench: Bench, hidden: dict[str, str]) -> Finding:
    """One check, in a thread that is left alone, and Webots ended, where it hangs."""
    from webots_mcp.plugins.prove.bench import NotTriedError, OtherwiseError

    came = queue.SimpleQueue[tuple[Outcome, str | None]]()

    def work() -> None:
        try:
            came.put(("as expected", check.function(bench)))
        except NotTriedError as error:
            came.put(("not tried", str(error)))
        except (OtherwiseError, AssertionError, WebotsMCPError) as error:
            came.put(("otherwise", str(error)))
        except Exception as error:  # noqa: BLE001 - what Webots answers can be anything
            came.put(("otherwise", f"{type(error).__name__}: {error}"))

    began_s = time.monotonic()
    thread = threading.Thread(target=work, daemon=True)
    bench.use(thread)
    thread.start()
    try:
        outcome, seen = came.get(timeout=check.limit_s + bench.patience_s)
    except queue.Empty:
        outcome, seen = "otherwise", "it hung"
        bench.end()
    return Finding(
        check.name,
        outcome,
        check.expected,
        _without(hidden, seen),
        check.otherwise if outcome == "otherwise" else None,
        round(time.monotonic() - began_s, 1),
    )


def _line(found: Finding) -> str:
    parts = [f"{found.check}: {found.outcome}"]
    if found.outcome == "otherwise":
        parts.append(f"expected: {found.expected}; seen: {found.seen}")
        parts.append(f"then: {found.works_still}")
    elif found.seen:
        parts.append(found.seen)
    return printable("; ".join(parts))


def _versions() -> dict[str, Any]:
    from webots_mcp import __version__

    return {
        "webots_mcp": __version__,
        "system": _system(),
        "machine": platform.machine(),
        "python": platform.python_version(),
    }


def _system() -> str:
    """Without the name of a kernel, which may be that of a machine."""
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        return f"{platform.system()} {platform.release()}"


def _hidden(folder: Path) -> dict[str, str]:
    """What no text may name, the longest first, and what stands there instead."""
    from webots_mcp.contract import host_name
    from webots_mcp.webots import find_webots

    found = find_webots()
    places = {
        str(folder): "FOLDER",
        str(folder.resolve()): "FOLDER",
        str(found.home or found.program): "WEBOTS",
        str(found.program): "WEBOTS",
        sys.executable: "PYTHON",
        sys.prefix: "PYTHON",
        str(Path(__file__).parents[2]): "PACKAGE",
        str(Path.home()): "~",
        host_name(): "HOST",
        getpass.getuser(): "USER",
    }
    names = [each for each in places if len(each) > 1]
    return {each: places[each] for each in sorted(names, key=len, reverse=True)}


def _without(hidden: dict[str, str], text: str | None) -> str | None:
    if text is None:
        return None
    for name, shown in hidden.items():
        text = re.sub(rf"(?<!\w){re.escape(name)}(?!\w)", lambda _, shown=shown: shown, text)
    return text[:_LONGEST]
