"""Commands about whether runs repeat: where two part, and the same run again and again."""

from __future__ import annotations

import json as json_
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from webots_mcp.cli.options import HERE, Count, Id, Json, Parameter, ToRobot, Where
from webots_mcp.cli.terminal import ending_by_event, print_notes, print_table
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.naming import listed

if TYPE_CHECKING:
    from webots_mcp.store.questions.first_difference import Parting, Repeats

By = Literal["reset", "reload", "process"]
_ROBOT: Final = ToRobot()
_REACHED: Final = "simulation time reached"
_OF_BEGINNING: Final = ("robot", "began_by")  # a second robot of a name has another one


def diff(
    first: Annotated[Id, Parameter("RUN", help="The id of a run.")],
    other: Annotated[Id, Parameter("RUN", help="The id of another.")],
    /,
    *,
    signals: Annotated[
        list[str] | None,
        Parameter("--signal", metavar="SIGNAL", negative=(), help="Only these, with '*'."),
    ] = None,
    limit: Annotated[Count | None, Parameter("-n", metavar="N", help="Most shown (10).")] = None,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Where two runs part: which signal is first not the same to the last digit, and how it grows.

        webots-mcp diff 3 4 --signal 'pose*'

    Parameters, code, world and versions that differ are named first. Rows are compared with those
    of the other run at the same simulation time; the others are counted.
    """
    from webots_mcp.cli.asking import ask_and_show
    from webots_mcp.questions.compare_runs import webots_compare_runs

    asked = {"run_ids": [first, other], "signals": signals, "limit": limit}
    ask_and_show(webots_compare_runs, asked | {"first_difference": True}, recorded, as_json=json)


def repeat(
    world: Annotated[
        Path | None,
        Parameter("WORLD", help="For --by process: the world (that of the newest run)."),
    ] = None,
    /,
    *,
    for_s: Annotated[float, Parameter("--for", metavar="S", help="Simulated seconds of each.")],
    by: Annotated[
        list[By] | None,
        Parameter(
            "--by",
            negative=(),
            help="How each begins (reset): the live simulation is reset, or reloaded, or a "
            "simulator is started for each. Several are compared with each other, too.",
        ),
    ] = None,
    number: Annotated[Count, Parameter("-n", metavar="N", help="How many runs (5).")] = 5,
    timeout_wall_s: Annotated[
        float, Parameter("--timeout", metavar="S", help="Wall seconds that each may take (300).")
    ] = 300.0,
    stand_in: Annotated[
        bool, Parameter("--stand-in", negative=(), help="With --by process: not Webots.")
    ] = False,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Run the same again, and say where the runs part from the first, and how it grows.

        webots-mcp repeat --by reset --by process -n 3 --for 20

    Each run is recorded and labelled. Runs after a reset or reload need a controller that is a
    Supervisor. Where they part and processes of their own do not, the reset is to blame.
    """
    ways = sorted(dict.fromkeys(by or ["reset"]))  # processes first: others are judged by them
    if number < 2 or not 0 < for_s < float("inf"):
        raise InvalidInputError(f"-n {number} --for {for_s:g}: two runs or more, of some seconds")
    if (world or stand_in) and "process" not in ways:
        raise InvalidInputError("WORLD and --stand-in are for --by process")
    file = _world(world, asked) if "process" in ways else None
    found: dict[str, Repeats] = {}
    for way in ways:
        if way == "process":
            assert file is not None
            run_ids = _in_processes(file, asked, for_s, number, timeout_wall_s, stand_in=stand_in)
        else:
            run_ids = [_live(way, asked, for_s, timeout_wall_s) for _ in range(number)]
        found[way] = _compared(run_ids, way, asked, for_s)
    across = _compared([each.run_ids[0] for each in found.values()], None, asked, for_s)
    verdict = _blame(found, dict(zip(ways[1:], across.partings, strict=True)))
    if json:
        answer = {way: _as_json(each) for way, each in found.items()}
        print(json_.dumps({**answer, "across": _as_json(across)["repeats"], "verdict": verdict}))
        return
    for way, each in found.items():
        print(f"by {way}:")
        _show(each)
    if len(found) > 1:
        print("the first of each:")
        _show(across)
    print_notes(filter(None, [verdict]))


def _world(world: Path | None, asked: ToRobot) -> Path:
    """The world that is named, or that of the robot's newest run."""
    if world is None:
        with asked.recording().view(asked.robot) as view:
            recorded = view.require_run().world
        if recorded is None:
            raise InvalidInputError("no world is known of the newest run: name WORLD")
        world = Path(recorded)
    return world.resolve()


def _in_processes(
    world: Path, asked: ToRobot, for_s: float, number: int, timeout_s: float, *, stand_in: bool
) -> list[int]:
    """Run it in simulators of their own, as trials without parameters; the runs as recorded."""
    from webots_mcp.steering import trial_run
    from webots_mcp.steering.trial_plan import WorldPlan
    from webots_mcp.store.parameters import Result, Trial, create_trial_set, trials_of

    plan = WorldPlan(
        world=str(world), robot=asked.robot, score="duration", parameters=[{}], for_s=for_s,
        repeats=number, timeout_s=timeout_s,
    )  # fmt: skip
    command_of = trial_run.stand_in if stand_in else trial_run.webots
    command_of(plan.world)
    recording = asked.recording(read_only=False)
    recording.create()
    with recording.writer() as connection:
        set_id = create_trial_set(connection, plan.text, plan.trials)
    simulators = trial_run.LocalSimulators(command_of, 1)
    set_run = trial_run.SetRun(recording, plan, simulators, threading.Event())

    def report(trial: Trial, result: Result) -> None:
        said = f"run {result.run_id}" if result.error is None else result.error
        print(f"{trial.number}/{number}  {said}", file=sys.stderr, flush=True)

    with ending_by_event(set_run.stopping):
        trial_run.run_trials(set_run, set_id, report)
    with recording.reader() as connection:
        found = [each.run_id for each in trials_of(connection, set_id) if each.run_id is not None]
    if len(found) < 2:
        raise CommandRefusedError(f"fewer than two runs were recorded: trial set {set_id} says why")
    return found


def _live(way: str, asked: ToRobot, for_s: float, timeout_s: float) -> int:
    """Let the live simulation begin anew and run; the run that was recorded."""
    from webots_mcp.cli.asking import ask
    from webots_mcp.questions.control_simulation import webots_run, webots_simulation_control

    to = {"robot": asked.robot, "timeout_wall_s": timeout_s}
    if way == "reload":
        _require_done(ask(webots_simulation_control, {"command": way, **to}, asked).data)
    asked_for = {"for_s": for_s, "reset": way == "reset", **to}
    answer = _require_done(ask(webots_run, asked_for, asked).data)
    if answer.get("stopped") != _REACHED:
        why = answer.get("stop_reason") or answer.get("stopped")
        raise CommandRefusedError(f"a run did not reach its end: {why}")
    return answer["run_id"]


def _require_done(answer: Mapping[str, Any] | None) -> Mapping[str, Any]:
    assert answer is not None  # no picture
    if answer.get("outcome") != "done":
        why = answer.get("error") or answer.get("hint") or "no answer in time"
        raise CommandRefusedError(f"a run did not reach its end ({answer.get('outcome')}): {why}")
    return answer


def _compared(run_ids: list[int], way: str | None, asked: ToRobot, for_s: float) -> Repeats:
    """The runs, which get labels unless they have been compared before."""
    from webots_mcp.store.questions.first_difference import compare_repeats
    from webots_mcp.store.questions.runs import annotate_run
    from webots_mcp.store.run_rows import fetch_run

    recording = asked.recording(read_only=False)
    with recording.writer() as connection:
        for number, run_id in enumerate(run_ids if way else (), 1):
            annotate_run(connection, run_id, label=f"repeat {number} of {len(run_ids)} by {way}")
        until_s = fetch_run(connection, run_ids[0]).started_sim_time_s + for_s
    with recording.reader() as connection:
        return compare_repeats(connection, run_ids, until_s=until_s, deadline_s=float("inf"))


def _blame(found: Mapping[str, Repeats], across: Mapping[str, Parting]) -> str | None:
    """Whose fault it is that runs part, where processes of their own tell.

    Args:
        found: By the way of beginning.
        across: Of each way but the first, its first run and that of the first way.
    """
    if len(found) < 2 or "process" not in found:
        return None
    if found["process"].are_equal is not True:
        return "processes of their own part as well, or tell nothing: a reset is not all of it"
    unlike = dict.fromkeys(name for each in across.values() for name in each.unlike)
    if named := [name for name in unlike if name not in _OF_BEGINNING]:
        return f"nothing is blamed: runs were not alike to begin with ({listed(named)})"
    blamed = [way for way in across if False in (found[way].are_equal, across[way].is_equal)]
    if blamed:
        return (
            f"the {' and the '.join(blamed)} is to blame: processes of their own repeat to the "
            "last digit; something of the run before is left, in the world or in the controller's "
            "own variables"
        )
    return "what was compared is the same, however a run begins"


def _as_json(found: Repeats) -> dict[str, Any]:
    from webots_mcp.questions.answers import ComparisonAnswer
    from webots_mcp.questions.compare_runs import parting_facts

    answers = [ComparisonAnswer(**parting_facts(each)) for each in found.partings]
    return {
        "run_ids": found.run_ids,
        "are_equal": found.are_equal,
        "verdict": found.verdict if found.partings else None,
        "repeats": [
            {"run_id": parting.run_ids[1], "is_equal": parting.is_equal}
            | answer.model_dump(mode="json", exclude_none=True)
            for parting, answer in zip(found.partings, answers, strict=True)
        ],
    }


def _show(found: Repeats) -> None:
    """A row for each run but the first, with how far its worst signal is apart until when."""
    marks = [f"{each:.3g} s" for each in found.partings[0].marks_s]
    rows = list[list[Any]]()
    for each in found.partings:
        first, worst = next(iter(each.parted), None), each.worst
        growth = worst.growth if worst and len(worst.growth) == len(marks) else [None] * len(marks)
        rows.append([each.run_ids[1], first and first.from_s, first and str(first),
                     worst and worst.name, *growth])  # fmt: skip
    if any(each.parted for each in found.partings):
        print_table(("run", "parts_at_s", "first", "worst", *marks), rows)
    notes = dict.fromkeys(note for each in found.partings for note in (*each.unread, *each.notes))
    print_notes([found.verdict, *notes])
