"""The command that checks a real Webots for what is known from its sources only."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts.validators import Number

from webots_mcp.cli.options import Json, Parameter, whole_number
from webots_mcp.cli.streams import progress_bar, shown_activity
from webots_mcp.cli.terminal import print_json, printable
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_OUTCOMES: Final = ("as expected", "otherwise", "not tried")


def prove(
    *,
    webots: Annotated[
        Path | None,
        Parameter(
            "--webots",
            metavar="WEBOTS",
            help="Folder or program of Webots. Default: as for 'webots-mcp launch'.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        Parameter("--only", metavar="CHECK", help="Run only this check; can be repeated."),
    ] = None,
    patience_s: Annotated[
        int,
        Parameter(
            "--patience",
            metavar="S",
            converter=whole_number,
            validator=Number(gte=1, lte=3600),
            help="Maximum seconds from a start to the first row. Default: 60.",
        ),
    ] = 60,
    as_json: Json = False,
) -> int:
    """Test on your Webots what webots-mcp assumes about it. This takes a few minutes.

        webots-mcp prove --json

    Starts Webots several times without a window, on a temporary world, and checks each statement of
    'webots-mcp help webots'. The output of --json names no file, user or machine: please attach it
    to an issue. Exit code 1: a statement does not hold.
    """
    from webots_mcp.contract import VERSION
    from webots_mcp.plugins.prove.fact_checks import CHECKS
    from webots_mcp.simulator.installations import find_webots
    from webots_mcp.simulator.starting import Start

    for name in only or ():
        if name not in CHECKS:
            raise InvalidInputError(f"--only {name!r} is none of {', '.join(CHECKS)}")
    if webots is not None:
        _choose(webots)
    for name in [each for each in os.environ if each.startswith("WEBOTS_MCP_")]:
        del os.environ[name]  # It could change how the controllers record.
    Start(
        Path(), None, headless=True, streams=False, port=0
    ).command_line()  # Raises if there is no Webots.
    found = _run_checks(only, patience_s, as_json=as_json)
    counts = {each: sum(one["outcome"] == each for one in found) for each in _OUTCOMES}
    if as_json:
        system = {"system": f"{platform.system()} {platform.release()}"}
        with suppress(OSError):  # The name of a kernel may contain that of the machine.
            system["system"] = platform.freedesktop_os_release()["PRETTY_NAME"]
        system |= {"machine": platform.machine(), "python": platform.python_version()}
        versions = {"webots": find_webots().version, "webots_mcp": VERSION}
        print_json({**versions, **system, "counts": counts, "checks": found})
    else:
        print(", ".join(f"{count} {outcome}" for outcome, count in counts.items()))
    return int(counts["otherwise"] > 0)


def _run_checks(only: list[str] | None, patience_s: int, *, as_json: bool) -> list[dict[str, Any]]:
    """Run the checks, print each outcome in a line, and return the outcomes."""
    from webots_mcp.plugins.prove.bench import Bench, run_check
    from webots_mcp.plugins.prove.fact_checks import CHECKS, NOT_TRIED

    found = list[dict[str, Any]]()
    with tempfile.TemporaryDirectory(prefix="webots-mcp-", ignore_cleanup_errors=True) as folder:
        bench = Bench(Path(folder) / "project", patience_s)
        try:
            names = only or [*CHECKS, *NOT_TRIED]
            for done, name in enumerate(names):
                answer: dict[str, Any] = {"outcome": "not tried", "seen": NOT_TRIED.get(name)}
                if name in CHECKS:
                    with _shown(name, done, len(names)):
                        answer = run_check(CHECKS[name], bench)
                parts = [f"{name}: {answer['outcome']}"]
                parts += [
                    f"{key}: {answer[key]}"
                    for key in ("expected", "seen", "works still")
                    if answer.get(key)
                ]
                found.append({"check": name, **answer})
                print(printable("; ".join(parts)), file=sys.stderr if as_json else None, flush=True)
        finally:
            bench.close()
    return found


def _shown(name: str, done: int, of: int) -> AbstractContextManager[None]:
    """Show on a terminal how many checks are done, and for how long this one has been running.

    Elsewhere the line of each check is the progress.
    """
    if not sys.stderr.isatty():
        return nullcontext()
    return shown_activity(f"{progress_bar(done, of)}check {done + 1} of {of}, {name}")


def _choose(path: Path) -> None:
    """Set the environment so that this Webots is found.

    Raises:
        CommandRefusedError: It is no Webots.
    """
    from webots_mcp.simulator.installations import HOME_VARIABLE, installations

    path = path.resolve()
    for home in (path, *path.parents[:4]):
        os.environ[HOME_VARIABLE] = str(home)
        if any(path in (each.home, each.program.resolve()) for each in installations()[:1]):
            return
    raise CommandRefusedError(f"{path} is neither the folder nor the program of a Webots")
