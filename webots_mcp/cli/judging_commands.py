"""Define the commands that judge runs: their checks, differences, repeatability and profile."""

from __future__ import annotations

import ast
import contextlib
import math
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, cast

from webots_mcp.cli.options import (
    HERE,
    Count,
    Id,
    Json,
    Parameter,
    Robot,
    Waiting,
    Where,
    make_chunks_first,
)
from webots_mcp.cli.streams import shown_activity
from webots_mcp.cli.terminal import is_verbose, print_answer, print_json, print_table
from webots_mcp.contract import host_name
from webots_mcp.database.files import placed
from webots_mcp.database.location import find_project
from webots_mcp.database.thread_stacks import INSTALLED, STEPPING
from webots_mcp.errors import CommandRefusedError, InvalidInputError, WebotsMCPError
from webots_mcp.extras.requirements import explain_extra
from webots_mcp.signals.naming import listed, spelled_out

if TYPE_CHECKING:
    from webots_mcp.judging.divergence import Parting

EXIT_CODES: Final = {"fail": 1, "not looked at": 2}
_ELEMENTS: Final = {  # The elements of JUnit XML, and the attributes that count them.
    "fail": ("failure", "failures"),
    "not looked at": ("error", "errors"),
    "not applicable": ("skipped", "skipped"),
    "not judged": ("skipped", "skipped"),
}
_WAITING: Final = Waiting()


def check(
    run_id: Annotated[
        Id | None, Parameter("RUN", help="Run number. Default: the newest run.")
    ] = None,
    /,
    *,
    expect: Annotated[
        list[str] | None,
        Parameter(
            "--expect",
            metavar="CONDITION",
            help="Condition that must hold, such as \"front_m > 0.1 during mode == 'drive'\". Can "
            "be "
            "repeated.",
        ),
    ] = None,
    junit: Annotated[
        Path | None,
        Parameter(
            "--junit", metavar="FILE", help="Also write the checks to this file as JUnit XML."
        ),
    ] = None,
    robot: Robot = None,
    as_json: Json = False,
    recorded: Where = HERE,
) -> int:
    """Check a run: motion against commands, sensors, pace, log, end, lost rows and goal.

        webots-mcp check 4 --junit check.xml

    Exit code 0: no check failed. 1: a check failed. 2: the run could not be read, or not all of it
    was checked.
    """
    from webots_mcp.cli.question_commands import ask, show
    from webots_mcp.questions.list_and_compare_runs import webots_check_run

    _compile(recorded)
    make_chunks_first(recorded.recording())
    given = {"run_id": run_id, "robot": robot, "expect": expect}
    reply = ask(webots_check_run, given, recorded)
    data = reply.data or {}
    shown = reply if as_json else reply._replace(data=_in_short(_as_typed(data)))
    if junit is not None:  # first, because the reader of the output may stop early
        _write(junit, data)
    show(webots_check_run, shown, recorded, as_json=as_json)
    return EXIT_CODES.get(data.get("outcome", ""), 0)


def _compile(recorded: Where) -> None:
    """Compile the project's expectations for controllers that start without a server."""
    from webots_mcp.store.project_file import NO_PROJECT, compile_project, file_of, read_project

    recording = recorded.recording(read_only=False)
    file = file_of(recording.data_dir)
    project = read_project(file) if file else NO_PROJECT
    # If nothing can be written, the check still uses what is recorded.
    with contextlib.suppress(WebotsMCPError, sqlite3.Error), recording.writer() as connection:
        compile_project(connection, project)


def _as_typed(answer: dict[str, Any]) -> dict[str, Any]:
    """Return the answer with commands instead of calls, and with passed checks in one line."""
    from webots_mcp.cli.question_commands import OPTIONS
    from webots_mcp.cli.wording import commands_by_tool

    def typed(cell: Any) -> Any:
        called = re.fullmatch(r"webots_(\w+)\(.*\)", str(cell))
        if called is None:
            if not isinstance(cell, str):
                return cell
            return cell.replace("webots_describe_signals(...)", _DESCRIBE_TYPED)
        if called[1] == "describe_signals":
            return _description_as_typed(cell)
        words = ["webots-mcp", commands_by_tool().get(called[1], called[1])]
        call: Any = ast.parse(cell, mode="eval").body
        for keyword in call.keywords:
            value: Any = ast.literal_eval(keyword.value)
            values = cast("list[Any]", value) if isinstance(value, list) else [value]
            for each in values:
                words += [OPTIONS.get(keyword.arg, f"--{keyword.arg}"), str(each)]
        return shlex.join(words)

    passed, table = answer.get("passed"), answer.get("checks")
    changed = {"passed": f"{len(passed)}: {', '.join(passed)}"} if passed else {}
    if table:
        changed["checks"] = table | {"rows": [[*map(typed, row)] for row in table["rows"]]}
    return answer | changed


def _in_short(answer: dict[str, Any]) -> dict[str, Any]:
    """Return the answer with inapplicable checks in one line, and no details of passed ones."""
    table = answer.get("checks")
    if is_verbose() or not table:
        return answer
    place, named = table["columns"].index("outcome"), table["columns"].index("check")
    found = [row for row in table["rows"] if row[place] != "not applicable"]
    others = [str(row[named]) for row in table["rows"] if row[place] == "not applicable"]
    short = {name: value for name, value in answer.items() if name not in ("passed_on", "counts")}
    short["checks"] = table | {"rows": found}
    if not found:
        del short["checks"]
    if others:
        short["not applicable"] = f"{len(others)}: {', '.join(others)}"
    if others or "passed_on" in answer:
        hint = "--verbose shows what each check rests on, and why others do not apply"
        short["hint"] = "; ".join(filter(None, (answer.get("hint"), hint)))
    return short


_DESCRIBE_TYPED: Final = "webots-mcp signals --describe"


def _description_as_typed(call: str) -> str:
    """Return the command that describes a signal, for the call of the tool."""
    keywords: Any = cast("Any", ast.parse(call, mode="eval").body).keywords
    said = {each.arg: ast.literal_eval(each.value) for each in keywords}
    (name,) = said.pop("signals")
    return f"{_DESCRIBE_TYPED} {shlex.join([name, *(f'{k}={v}' for k, v in said.items())])}"


def _write(file: Path, answer: dict[str, Any]) -> None:
    """Write an answer as JUnit XML; a warning passes and appears in `system-out`.

    Raises:
        InvalidInputError: The file cannot be written.
    """
    from xml.etree.ElementTree import Element, SubElement, tostring

    suite = Element("testsuite", name=f"run {answer.get('run_id')} of {answer.get('robot')}")
    counts = Counter[str](tests=0, failures=0, errors=0, skipped=0)
    for each in _checks_in(answer):
        name, says = spelled_out(each["check"]), spelled_out(each.get("evidence") or "")
        case = SubElement(suite, "testcase", classname="webots-mcp", name=name)
        says += f" (since {each['start_s']:g} s)" if each.get("start_s") is not None else ""
        element, counted = _ELEMENTS.get(each["outcome"], ("", ""))
        counts.update(filter(None, ("tests", counted)))
        if element:
            SubElement(case, element, message=says)
        elif each["outcome"] == "warn":
            SubElement(case, "system-out").text = f"warning: {says}"
    suite.attrib |= {name: str(count) for name, count in counts.items()}
    with placed(file) as aside:
        aside.write_bytes(tostring(suite, "utf-8", xml_declaration=True))


def _checks_in(answer: dict[str, Any]) -> list[dict[str, Any]]:
    table: Any = answer.get("checks") or {"columns": [], "rows": []}
    found = [dict(zip(table["columns"], row, strict=True)) for row in table["rows"]]
    return [*found, *({"check": name, "outcome": "pass"} for name in answer.get("passed") or ())]


# -- whether runs repeat ---------------------------------------------------------------------------

By = list[Literal["reset", "reload", "process"]] | None
_Names = list[str] | None
_World = Path | None


def first_difference(
    first: Annotated[Id, Parameter("RUN", help="Numbers of the two runs to compare.")],
    other: Annotated[Id, Parameter("RUN", help="Numbers of the two runs to compare.")],
    /,
    *,
    signals: Annotated[
        _Names,
        Parameter(
            "--signal",
            metavar="SIGNAL",
            negative=(),
            help="Compare only these signals; '*' means any text.",
        ),
    ] = None,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Find where two runs diverge: the first signal that differs, and how the difference grows.

        webots-mcp first-difference 3 4 --signal 'pose*'

    Differing parameters, code, worlds and versions are listed first. Rows are compared at equal
    simulated times, to the last digit; rows without a counterpart are counted.
    """
    from webots_mcp.cli.question_commands import ask_and_show
    from webots_mcp.questions.list_and_compare_runs import webots_compare_runs

    asked = {"run_ids": [first, other], "signals": signals, "first_difference": True}
    ask_and_show(webots_compare_runs, asked, recorded, as_json=json)


def repeatability(
    world: Annotated[
        _World, Parameter("WORLD", help="World for --by process. Default: that of the newest run.")
    ] = None,
    /,
    *,
    for_s: Annotated[float, Parameter("--for", metavar="S", help="Simulated seconds per run.")],
    by: Annotated[
        By,
        Parameter(
            "--by",
            negative=(),
            help="How each run begins; can be repeated. Default: reset.",
        ),
    ] = None,
    number: Annotated[
        Count, Parameter("-n", metavar="N", help="Number of runs of each kind. Default: 5.")
    ] = 5,
    stand_in: Annotated[
        bool,
        Parameter("--stand-in", negative=(), help="Use the stand-in simulator, not Webots."),
    ] = False,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Repeat a run several times, and find where the repeats diverge and how the difference grows.

        webots-mcp repeatability --by reset --by process -n 3 --for 20

    A run begins with a reset or reload of the live simulation, whose controller must be a
    Supervisor, or in a simulator process of its own, as a trial does. If runs diverge after a reset
    but not between processes, the reset is the cause.
    """
    from webots_mcp.judging.divergence import compare_repeats
    from webots_mcp.store.run_rows import fetch_run
    from webots_mcp.store.runs import annotate_run

    # processes first, because the others are compared with them
    ways = sorted(dict.fromkeys(by or ["reset"]))
    if number < 2:
        raise InvalidInputError(
            f"-n {number} is too few: at least two runs are needed to compare. Use -n 2 or more."
        )
    if (world or stand_in) and "process" not in ways:
        raise InvalidInputError(
            "WORLD and --stand-in apply only to processes. Add --by process, or leave them out."
        )
    runs = dict[str, list[int]]()
    for way in ways:
        if way == "process":
            runs[way] = _in_processes(world, asked, for_s, number, stand_in=stand_in)
        else:
            runs[way] = []
            for at in range(1, number + 1):
                with shown_activity(f"run {at} of {number}, by {way}"):
                    runs[way].append(_live(way, asked, for_s))
            with asked.recording(read_only=False).writer() as connection:
                for at, run_id in enumerate(runs[way], 1):
                    annotate_run(connection, run_id, label=f"repeat {at} of {number}, by {way}")
    if len(ways) > 1:
        runs["the first of each"] = [run_ids[0] for run_ids in runs.values()]
    found: dict[str, list[Parting]] = {}
    with asked.recording().reader() as connection, shown_activity("comparing the runs"):
        for way, run_ids in runs.items():
            until_s = fetch_run(connection, run_ids[0]).started_sim_time_s + for_s
            found[way] = compare_repeats(connection, run_ids, until_s=until_s, deadline_s=math.inf)
    answer: dict[str, Any] = {way: _answer(each) for way, each in found.items()}
    blame = _blame(found)
    if json:
        return print_json(answer | blame)
    verdicts = (f"{way}: {each['verdict']}" for way, each in answer.items())
    print_answer({"summary": blame.get("verdict") or "; ".join(verdicts)} | answer)


def _in_processes(
    world: Path | None, asked: Waiting, for_s: float, number: int, *, stand_in: bool
) -> list[int]:
    """Run a world in separate simulators, as trials without parameters."""
    from webots_mcp.cli.steering_commands import TrialOptions, run_plan
    from webots_mcp.steering.trial_plan import WorldPlan
    from webots_mcp.store.trial_sets import trials_of

    recording = asked.recording(read_only=False)
    if world is None:
        with recording.view(asked.robot) as view:
            world = Path(view.require_run().world or "")
    plan = WorldPlan(
        world=str(world.resolve()), robot=asked.robot, score="duration", parameters=[{}],
        for_s=for_s, repeats=number, timeout_s=asked.timeout_wall_s or 600.0,
    )  # fmt: skip
    set_id = run_plan(recording, plan, TrialOptions(stand_in=stand_in, again=True))
    with recording.reader() as connection:
        found = [each.run_id for each in trials_of(connection, set_id) if each.run_id is not None]
    if len(found) < 2:
        raise CommandRefusedError(
            "Fewer than two runs were recorded, so nothing can be compared. See 'webots-mcp logs'."
        )
    return found


def _live(way: str, asked: Waiting, for_s: float) -> int:
    """Restart the live simulation and let it run. Return the recorded run."""
    from webots_mcp.cli.question_commands import ask
    from webots_mcp.questions.control_simulation import webots_run, webots_world_reload

    to: dict[str, Any] = {"robot": asked.robot, "timeout_wall_s": asked.timeout_wall_s}
    answer: dict[str, Any] = {}
    if way == "reload":
        answer = ask(webots_world_reload, to, asked).data or {}
    if way == "reset" or answer["outcome"] == "done":
        to |= {"for_s": for_s, "reset": way == "reset"}
        answer = ask(webots_run, to, asked).data or {}
    if answer.get("stopped") != "simulation time reached":
        why = (answer.get(each) for each in ("error", "stopped", "stop_reason", "hint"))
        raise CommandRefusedError("; ".join(["A run did not reach its end", *filter(None, why)]))
    return answer["run_id"]


def _blame(found: Mapping[str, Sequence[Parting]]) -> dict[str, str]:
    """Say what makes runs diverge, if separate processes show it."""
    first, *ways = found
    if first != "process" or not ways:
        return {}
    if not all(each.is_equal for each in found[first]):
        return {
            "verdict": "runs in processes of their own diverge as well, or could not be compared"
        }
    across = dict(zip(ways, found[ways.pop()], strict=False))
    unlike = {name: None for each in across.values() for name in each.unlike}
    blamed = [way for way in ways if any(each.parted for each in (across[way], *found[way]))]
    if named := [name for name in unlike if name not in ("robot", "began_by")]:
        return {"verdict": f"no cause is named: the runs began with differences ({listed(named)})"}
    said = (
        f"the {' and the '.join(blamed)} is the cause: runs in processes of their own are identical"
    )
    return {"verdict": said if blamed else "the runs are identical, however they begin"}


def _answer(found: Sequence[Parting]) -> dict[str, Any]:
    from webots_mcp.judging.divergence import verdict_on
    from webots_mcp.questions.list_and_compare_runs import parting_facts

    facts = [{"run_id": each.run_ids[1], **parting_facts(each)} for each in found]
    shown = ("run_id", "verdict", "growth", "notes")
    diverging = [each.run_ids[1] for each in found if each.parted]
    return {
        "run_ids": [found[0].run_ids[0], *(each["run_id"] for each in facts)],
        "diverging": diverging,
        "parted": diverging,  # its former name, kept for scripts
        "verdict": verdict_on(found),
        "repeats": [{name: each[name] for name in shown if each[name]} for each in facts],
    }


# -- what takes the time ---------------------------------------------------------------------------


def profile(
    robot: Annotated[
        str | None, Parameter("ROBOT", help="Name of the robot. Needed only if several are live.")
    ] = None,
    /,
    *,
    seconds: Annotated[
        Count, Parameter("--for", metavar="S", help="Wall-clock seconds to sample. Default: 10.")
    ] = 10,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Find the lines of a Python controller that take the most time, by sampling it with py-spy.

        webots-mcp profile rover --for 20

    Samples the main thread 100 times a second and counts lines of the controller's own files, with
    everything they call. Time spent sleeping or waiting counts too. A sample stops the controller
    for about a millisecond.
    """
    with recorded.recording().view(robot) as view:
        name, session = view.robot.name, view.session
    if session is None or not view.robot.live or session.host != host_name():
        raise CommandRefusedError(
            f"No controller of {name} is running on this machine. Start the simulation first."
        )
    if not session.has_bridge:
        raise CommandRefusedError(
            f"{name} is not recorded by a Python controller, so its lines cannot be sampled."
        )
    controller = Path(session.controller or "/nowhere")
    own = str(find_project(controller.parent) or controller.parent)
    samples = Counter[tuple[str, str | None]]()
    with shown_activity(f"sampling {name} for {seconds} s"):
        for stack, count in _sampled(session.pid, seconds):
            samples[_place_of(stack, own)] += count
    total = samples.total()
    columns = ("share", "line", "function", "samples")
    rows = [[f"{n / total:.1%}", *place, n] for place, n in samples.most_common(12)]
    if json:
        found = {"robot": name, "seconds": seconds, "samples": total}
        return print_json(found | {"columns": columns, "rows": rows})
    (first, function), most = samples.most_common(1)[0]
    where = f"{first} in {function}" if function else first
    print(f"{name} spends {most / total:.0%} of its time {'at ' if function else ''}{where}.")
    print_table(columns, rows)
    print(f"{total} samples of its main thread in {seconds} s")


def _sampled(pid: int, seconds: int) -> list[tuple[str, int]]:
    """Return the stacks of the main thread, and how often each was met.

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
        raise CommandRefusedError(
            f"py-spy is not allowed to sample process {pid}. On Linux run 'sudo sysctl "
            "kernel.yama.ptrace_scope=0', for a container add --cap-add SYS_PTRACE, on macOS run "
            "this command as root."
        )
    *_, said = ended.stderr.strip().splitlines() or ["it has written nothing"]
    raise CommandRefusedError(f"py-spy could not sample process {pid}: {said}")


def _place_of(stack: str, own: str) -> tuple[str, str | None]:
    """Return the innermost line of the controller's own files, and its function."""
    in_bridge = False
    for each in reversed(stack.split(";")):
        function, file, line = (
            found.groups() if (found := re.match(r"(.*) \((.*):(\d+)\)$", each)) else ("", "", "")
        )
        is_own = file.startswith(own) and not re.search(INSTALLED, file)
        if function.rpartition(".")[2] in STEPPING and not is_own:
            return ("waiting in step()", None)
        if is_own:
            return (
                ("in the bridge", None)
                if in_bridge
                else (f"{Path(file).name}:{line}", f"{function}()")
            )
        in_bridge = in_bridge or file.startswith(str(Path(__file__).parents[1]))
    return ("in no file of the controller", None)
