"""Commands about whether runs repeat: where two part, and the same run again and again."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from webots_mcp.cli.options import HERE, Count, Id, Json, Parameter, Waiting, Where
from webots_mcp.cli.terminal import print_answer, print_json
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.naming import listed

if TYPE_CHECKING:
    from webots_mcp.store.questions.first_difference import Parting

By = list[Literal["reset", "reload", "process"]] | None
_Names = list[str] | None
_World = Path | None
_WAITING: Final = Waiting()


def diff(
    first: Annotated[Id, Parameter("RUN", help="The id of a run.")],
    other: Annotated[Id, Parameter("RUN", help="The id of another.")],
    /,
    *,
    signals: Annotated[
        _Names, Parameter("--signal", negative=(), help="Only these, with '*'.")
    ] = None,
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

    asked = {"run_ids": [first, other], "signals": signals, "first_difference": True}
    ask_and_show(webots_compare_runs, asked, recorded, as_json=json)


def repeat(
    world: Annotated[_World, Parameter("WORLD", help="Of processes (the newest run's).")] = None,
    /,
    *,
    for_s: Annotated[float, Parameter("--for", metavar="S", help="Simulated seconds of each.")],
    by: Annotated[By, Parameter("--by", negative=(), help="How each begins (reset).")] = None,
    number: Annotated[Count, Parameter("-n", help="How many of each (5).")] = 5,
    stand_in: Annotated[bool, Parameter("--stand-in", negative=(), help="Not Webots.")] = False,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Run the same again, and say where the runs part from the first, and how it grows.

        webots-mcp repeat --by reset --by process -n 3 --for 20

    Each begins with a reset or reload of the live simulation, whose controller has to be a
    Supervisor, or in a simulator process of its own, as a trial does. Where runs part after a
    reset, and processes of their own do not, the reset is to blame.
    """
    from webots_mcp.store.questions.first_difference import compare_repeats
    from webots_mcp.store.run_rows import fetch_run

    ways = sorted(dict.fromkeys(by or ["reset"]))  # processes first: others are judged by them
    if number < 2:
        raise InvalidInputError(f"-n {number}: it takes two runs to see whether they are the same")
    if (world or stand_in) and "process" not in ways:
        raise InvalidInputError("WORLD and --stand-in are for --by process")
    runs = dict[str, list[int]]()
    for way in ways:
        if way == "process":
            runs[way] = _in_processes(world, asked, for_s, number, stand_in=stand_in)
        else:
            runs[way] = [_live(way, asked, for_s) for _ in range(number)]
    if len(ways) > 1:
        runs["the first of each"] = [run_ids[0] for run_ids in runs.values()]
    found: dict[str, list[Parting]] = {}
    with asked.recording().reader() as connection:
        for way, run_ids in runs.items():
            until_s = fetch_run(connection, run_ids[0]).started_sim_time_s + for_s
            found[way] = compare_repeats(connection, run_ids, until_s=until_s, deadline_s=math.inf)
    answer: dict[str, Any] = {way: _answer(each) for way, each in found.items()}
    (print_json if json else print_answer)(answer | _blame(found))


def _in_processes(
    world: Path | None, asked: Waiting, for_s: float, number: int, *, stand_in: bool
) -> list[int]:
    """Run a world in simulators of their own, as trials without parameters."""
    from webots_mcp.cli.steering import TrialOptions, run_plan
    from webots_mcp.steering.trial_plan import WorldPlan
    from webots_mcp.store.parameters import trials_of

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
        raise CommandRefusedError("fewer than two runs were recorded")
    return found


def _live(way: str, asked: Waiting, for_s: float) -> int:
    """Let the live simulation begin anew and run; the run that was recorded."""
    from webots_mcp.cli.asking import ask
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
        raise CommandRefusedError("; ".join(["a run did not reach its end", *filter(None, why)]))
    return answer["run_id"]


def _blame(found: Mapping[str, Sequence[Parting]]) -> dict[str, str]:
    """Whose fault it is that runs part, where processes of their own tell."""
    first, *ways = found
    if first != "process" or not ways:
        return {}
    if not all(each.is_equal for each in found[first]):
        return {"verdict": "processes of their own part as well, or tell nothing"}
    across = dict(zip(ways, found[ways.pop()], strict=False))
    unlike = {name: None for each in across.values() for name in each.unlike}
    blamed = [way for way in ways if any(each.parted for each in (across[way], *found[way]))]
    if named := [name for name in unlike if name not in ("robot", "began_by")]:
        return {"verdict": f"nothing is blamed: not alike to begin with ({listed(named)})"}
    said = f"the {' and the '.join(blamed)} is to blame: processes of their own repeat"
    return {"verdict": said if blamed else "what was compared is the same, however a run begins"}


def _answer(found: Sequence[Parting]) -> dict[str, Any]:
    from webots_mcp.questions.compare_runs import parting_facts
    from webots_mcp.store.questions.first_difference import verdict_on

    facts = [{"run_id": each.run_ids[1], **parting_facts(each)} for each in found]
    shown = ("run_id", "verdict", "growth", "notes")
    return {
        "run_ids": [found[0].run_ids[0], *(each["run_id"] for each in facts)],
        "parted": [each.run_ids[1] for each in found if each.parted],
        "verdict": verdict_on(found),
        "repeats": [{name: each[name] for name in shown if each[name]} for each in facts],
    }
