"""Commands that steer a simulation, where one asks several questions or a part of one.

What an assistant can ask for, a person can: each is answered as the MCP tool answers it.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from webots_mcp.cli.data import write_picture
from webots_mcp.cli.ending import ending_by_event
from webots_mcp.cli.options import (
    HERE,
    Count,
    Id,
    Json,
    Parameter,
    RunId,
    ToRobot,
    ToWebots,
    Waiting,
    Where,
    whole_number,
)
from webots_mcp.cli.terminal import clock_text, print_json, print_notes, print_table, text_of
from webots_mcp.contract import BreakpointAction
from webots_mcp.errors import InvalidInputError, NothingRecordedError

if TYPE_CHECKING:
    from webots_mcp.analysis.summary import Ranking
    from webots_mcp.questions.declaring import Question
    from webots_mcp.steering.trial_plan import WorldPlan
    from webots_mcp.steering.trial_run import Simulators
    from webots_mcp.store.recording import RecordingAccess
    from webots_mcp.store.trial_sets import TrialRecord, TrialResult

_ROBOT: Final = ToRobot()
_WAITING: Final = Waiting()
_WEBOTS: Final = ToWebots()
_WHERE: Final = Where()


def pause(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Pause the simulation; its controller goes on answering."""
    _control("pause", asked, as_json=json)


def resume(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Let a paused simulation go on, in real time."""
    _control("resume", asked, as_json=json)


def step(
    steps: Annotated[
        int, Parameter("N", converter=whole_number, help="Rounds of its loop (1).")
    ] = 1,
    /,
    *,
    asked: ToWebots = _WEBOTS,
    json: Json = False,
) -> None:
    """Let the controller's own loop come round N times, then pause."""
    _control("step", asked, as_json=json, steps=steps)


def fast(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Let the simulation run as fast as it can."""
    _control("fast", asked, as_json=json)


def reset(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Reset the simulation to its first state; a new run begins at time 0.

    Controllers keep running with the code they have. `webots-mcp reload` restarts them.
    """
    _control("reset", asked, as_json=json)


def reload(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Reload the world and restart its controllers with their code as it is now.

    An extern controller ends and must be started by hand.
    """
    _control("reload", asked, as_json=json)


def _control(command: str, asked: ToWebots, *, as_json: bool, **given: Any) -> None:
    from webots_mcp.questions.control_simulation import webots_simulation_control

    _show(webots_simulation_control, asked, as_json=as_json, command=command, **given)


def capture(
    reason: Annotated[str, Parameter("REASON", help="Why, as it is shown with the stretch.")],
    /,
    *,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Keep the last seconds of a running controller at full rate, and the two that follow.

    Each call of publish in them becomes a row, also those that the throttle drops.
    """
    from webots_mcp.questions.send_command import webots_send_command

    params = {"reason": reason}
    _show(webots_send_command, asked, as_json=json, action="keep", params=params)


def parameters(
    *settings: Annotated[str, Parameter("NAME=VALUE", help="Set these, all or none.")],
    asked: Waiting = _WAITING,
    run_id: RunId = None,
    from_reset: Annotated[
        bool, Parameter("--from-reset", help="Not now, but from the next reset on.")
    ] = False,
    json: Json = False,
) -> None:
    """Show the parameters that a controller declares, or set some while it runs.

    All are set between two rounds of its loop, or none. A reset keeps them; a reload begins with
    those in the code.

        webots-mcp parameters kp=3.5 gait=trot
    """
    from webots_mcp.questions.controller_parameters import (
        webots_get_parameters,
        webots_set_parameters,
    )

    if from_reset and not settings:
        raise InvalidInputError("--from-reset needs what is set then: NAME=VALUE")
    if not settings:
        return _show(webots_get_parameters, asked, as_json=json, run_id=run_id)
    if run_id is not None:
        raise InvalidInputError("--run shows an earlier run; parameters are set in the current one")
    when = "reset" if from_reset else "now"
    _show(webots_set_parameters, asked, as_json=json, values=settings, when=when)


def signals(
    *words: Annotated[
        str,
        Parameter(
            "PATTERN",
            help=r"Of signals; '\*' is any text. (\*) With --describe: FIELD=VALUE, such as "
            "quantity=speed.",
        ),
    ],
    describe: Annotated[
        str | None,
        Parameter("--describe", metavar="NAME", help="Say what the signals of this name mean."),
    ] = None,
    undo: Annotated[
        str | None,
        Parameter("--undo", metavar="NAME", help="Remove what was declared of these signals."),
    ] = None,
    meanings: Annotated[
        bool, Parameter("--meanings", negative=(), help="List what they mean, and why.")
    ] = False,
    limit: Annotated[Count, Parameter("-n", metavar="N", help="Most shown (100).")] = 100,
    cursor: Annotated[
        int | None, Parameter("--after", converter=whole_number, help="From the last answer.")
    ] = None,
    run_id: RunId = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """List the signals of a run: kind, last value, range, missing values, meaning and its source.

        webots-mcp signals 'front*'

    Describe those whose meaning is unknown or wrong. The fields are quantity, role, unit,
    target_of, same_as, side, low and high; 'webots-mcp help meanings' lists their values. A
    description applies to past runs too.

        webots-mcp signals --describe motors.left quantity='wheel speed' role=commanded
    """
    from webots_mcp.questions.describe_signals import webots_describe_signals, webots_list_meanings
    from webots_mcp.questions.history import webots_list_signals

    if describe is not None and undo is not None:
        raise InvalidInputError("give --describe NAME or --undo NAME, not both")
    if describe is not None:
        said = _fields_of(words)
        return _show(webots_describe_signals, asked, as_json=json, signals=[describe], **said)
    if undo is not None and words:
        raise InvalidInputError(f"--undo takes one name: leave out {words[0]!r}")
    if undo is not None:
        return _show(webots_describe_signals, asked, as_json=json, signals=[undo], undo=True)
    if meanings:
        names = [*words] or None
        return _show(webots_list_meanings, asked, as_json=json, signals=names)
    if len(words) > 1:
        raise InvalidInputError(f"give one pattern, in quotes: {words[1]!r} is too much")
    given = {"pattern": words[0]} if words else {}
    given |= {"limit": limit, "cursor": cursor, "run_id": run_id}
    _show(webots_list_signals, asked, as_json=json, **given)


def _fields_of(words: tuple[str, ...]) -> dict[str, Any]:
    """What is said of a signal, of texts FIELD=VALUE; only limits are numbers."""
    from webots_mcp.cli.options import settings_of
    from webots_mcp.signals.meaning import MEANING_FIELDS

    limits = ("low", "high")
    kinds = dict.fromkeys((each for each in MEANING_FIELDS if each not in limits), "str")
    said = settings_of(words, kinds)
    if not said:
        raise InvalidInputError("--describe NAME needs FIELD=VALUE, such as quantity=speed")
    if unknown := [name for name in said if name not in MEANING_FIELDS]:
        fields = ", ".join(MEANING_FIELDS)
        raise InvalidInputError(f"unknown field {unknown[0]!r:.80}. Fields: {fields}")
    return said


def breakpoint_(
    condition: Annotated[
        str | None, Parameter("CONDITION", help="Such as 'front_m < 0.1 for 0.5'.")
    ] = None,
    /,
    *,
    action: Annotated[BreakpointAction, Parameter("--action", help="At a hit (pause).")] = "pause",
    after_hits: Annotated[
        Count, Parameter("--after-hits", metavar="N", help="Act from this hit of a run on (1).")
    ] = 1,
    breakpoint_id: Annotated[
        Id | None, Parameter("--remove", metavar="ID", help="Remove the one with this id.")
    ] = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Pause, or take note, when a condition begins to hold; without one, list the breakpoints.

        webots-mcp breakpoint 'front_m < 0.1' --action log

    It is asked of every published state, stored, and armed again after a reset or reload.
    """
    from webots_mcp.questions import set_breakpoints

    if condition is not None and breakpoint_id is not None:
        raise InvalidInputError("give a condition to set, or --remove ID, not both")
    if breakpoint_id is not None:
        remove = set_breakpoints.webots_remove_breakpoint
        return _show(remove, asked, as_json=json, breakpoint_id=breakpoint_id)
    if condition is None:
        return _show(set_breakpoints.webots_list_breakpoints, asked, as_json=json)
    given = {"condition": condition, "action": action, "after_hits": after_hits}
    _show(set_breakpoints.webots_breakpoint, asked, as_json=json, **given)


def field(
    path: Annotated[str, Parameter("PATH", help="Such as ROVER.translation or BALL.physics.mass.")],
    value: Annotated[
        str | None,
        Parameter(
            "VALUE",
            help="Set it: '[0, 1, 0.04]', 0.5, true, a text.",
            allow_leading_hyphen=True,
        ),
    ] = None,
    /,
    *,
    start: Annotated[
        int | None,
        Parameter(
            "--start",
            metavar="N",
            converter=whole_number,
            help="Show its entries from this one on.",
        ),
    ] = None,
    stop: Annotated[bool, Parameter("--stop", help="Take the speed of its node too.")] = False,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Show a field of the scene tree, or all fields of a node; or set one.

    What is set is recorded as an event; a reset puts it back.

        webots-mcp field ROVER.translation '[0, 1, 0.04]'
    """
    from webots_mcp.questions.edit_scene import webots_get_field, webots_set_field

    if stop and value is None:
        raise InvalidInputError("--stop goes with a VALUE that is set")
    if value is None:
        return _show(webots_get_field, asked, as_json=json, path=path, start=start)
    _show(webots_set_field, asked, as_json=json, path=path, value=value, stop=stop)


def _show(question: Question, asked: ToRobot, *, as_json: bool, **given: Any) -> None:
    """Ask a question, with those options that it has, and print the answer."""
    from webots_mcp.cli.asking import ask_and_show

    of_options = {name: value for name, value in vars(asked).items() if _has(question, name)}
    ask_and_show(question, of_options | given, asked, as_json=as_json)


def _has(question: Question, argument: str) -> bool:
    return any(each.name == argument for each in question.parameters)


def audit(
    *,
    number: Annotated[Count, Parameter("-n", metavar="N", help="The newest N (20).")] = 20,
    refused: Annotated[
        bool, Parameter("--refused", negative=(), help="Only what a rule has refused.")
    ] = False,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """Who asked for what that changes something, and what became of it; newest first.

    MCP clients, this command line and the page; see 'webots-mcp help policy'. No row is ever
    deleted.
    """
    from webots_mcp.store.requests import newest_requests

    with recorded.reader() as connection:
        found = newest_requests(connection, number, refused=refused)
    if json:
        return print_json({"requests": found})
    if not found:
        return print("no request was refused" if refused else "nothing was asked for yet")
    print_table(
        ("id", "when", "at_s", "by", "tool", "arguments", "outcome", "commands"),
        [_request_row(each) for each in found],
    )


def _request_row(request: dict[str, Any]) -> list[Any]:
    by = f"{request['client']} {request['client_version']} ({request['transport']})"
    outcome = request["outcome"] or "no answer: under way, or its process was ended"
    if request["rule"]:
        outcome = f"{outcome} by {request['rule']}"
    commands = "; ".join(f"{number} {action} {status}" for number, action, status in
                         request["commands"])  # fmt: skip
    when = clock_text(request["wall_time_s"])
    told = [request["id"], when, request["sim_time_s"], by, request["tool"]]
    return [*told, request["arguments"] or None, outcome, commands or None]


# -- trials of a plan file, each in a simulator of its own --


@Parameter(name="*")
@dataclass(frozen=True)
class TrialOptions:
    """Where and how the trials run."""

    jobs: Annotated[
        Count | None,
        Parameter(
            "--jobs",
            metavar="N",
            help="At most N trials at once, each in a simulator of its own (1; with --scheduler as "
            "many as its workers can run).",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        Parameter(
            "--scheduler",
            metavar="ADDRESS",
            help="On the workers of a Dask cluster, such as tcp://HOST:8786.",
        ),
    ] = None
    ship_to: Annotated[
        str | None,
        Parameter(
            "--ship-to",
            metavar="URL",
            help="With --scheduler: large recordings come through this pool, and stay in it.",
        ),
    ] = None
    stand_in: Annotated[
        bool, Parameter("--stand-in", help="On the stand-in instead of Webots.")
    ] = False
    again: Annotated[
        bool,
        Parameter("--again", help="From the start, also where all trials of the plan are done."),
    ] = False


_DEFAULTS: Final = TrialOptions()


def trials(
    plan: Annotated[Path, Parameter("PLAN", help="A .toml file: see 'webots-mcp help trials'.")],
    /,
    *,
    options: TrialOptions = _DEFAULTS,
    search: Annotated[
        Literal["tpe", "random"] | None,
        Parameter(
            "--search",
            metavar="SAMPLER",
            help="Search the plan's [ranges]: tpe or random, by Optuna (pip install optuna).",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        Parameter(
            "--plot",
            metavar="FILE",
            help="A .png or .svg file: the scores over the parameters.",
        ),
    ] = None,
    so_far: Annotated[
        bool,
        Parameter(
            "--so-far",
            help="Only print what is over, also while another process works on it.",
        ),
    ] = False,
    recorded: Where = _WHERE,
    json: Json = False,
) -> None:
    """Try sets of parameters in runs of their own, score each run, and rank the sets.

        webots-mcp trials plan.toml --jobs 4 --search tpe

    Each trial runs in a simulator and a data folder of its own; what it recorded is merged into
    the recording, where its run can be looked at like any other.

    With --scheduler the trials run on the workers of a Dask cluster, each of which has to have the
    resource simulator=1: dask worker tcp://HOST:8786 --resources simulator=1 --nthreads 1

    Ended by Ctrl-C or killed, the same command goes on with what is left.
    """
    from webots_mcp.steering.trial_plan import read_plan

    found = read_plan(plan, search)
    draw = _picture_of(plot)
    if so_far:
        recording = recorded.recording()
        set_id = _begun_set(recording, plan, found, options)
    else:
        recording = recorded.recording(read_only=False)
        set_id = run_plan(recording, found, options)
    _show_trials(recording, set_id, found, as_json=json)
    if draw is not None:
        draw(recording, set_id)


def run_plan(recording: RecordingAccess, plan: WorldPlan, options: TrialOptions) -> int:
    """Run what is left of the plan's set; returns its id."""
    from webots_mcp.steering.trial_search import require_optuna
    from webots_mcp.steering.trial_set import SetRun, run_trials
    from webots_mcp.store.requests import BY_COMMAND_LINE, OpenRequest

    if plan.search:
        require_optuna()
    with _simulators(options, plan) as simulators:
        recording.create()
        names, asked = ["trials", "webots_run_trials"], json.loads(plan.text)
        set_run = SetRun(recording, plan, simulators, threading.Event())
        with (
            OpenRequest(recording, BY_COMMAND_LINE, names, asked),
            ending_by_event(set_run.stopping),
        ):
            set_id = _set_of(recording, plan, options)
            run_trials(set_run, set_id, _TrialProgress(recording, set_id, plan).tell)
    return set_id


def _simulators(options: TrialOptions, plan: WorldPlan) -> AbstractContextManager[Simulators]:
    """Return where the trials run; that the program exists is checked first."""
    from webots_mcp.steering.trial_run import LocalSimulators, stand_in, webots

    if options.scheduler is not None:
        return _cluster(options, plan)
    if options.ship_to is not None:
        raise InvalidInputError("--ship-to is for --scheduler: what runs here is merged as it is")
    command_of = stand_in if options.stand_in else webots
    command_of(plan.world)
    return nullcontext(LocalSimulators(command_of, options.jobs or 1))


@contextmanager
def _cluster(options: TrialOptions, plan: WorldPlan) -> Generator[Simulators]:
    from webots_mcp.extras.plugin_registry import cluster_offered, load

    with load(cluster_offered())(
        options.scheduler,
        plan,
        is_stand_in=options.stand_in,
        most=options.jobs,
        ship_to=options.ship_to,
    ) as simulators:
        for note in simulators.notes:
            print(f"webots-mcp: {note}", file=sys.stderr)
        yield simulators


def _picture_of(file: Path | None) -> Callable[[RecordingAccess, int], None] | None:
    """Return what draws the picture that is asked for; None where none is."""
    if file is None:
        return None
    from webots_mcp.plotting.canvas import Sheet, image_format_of
    from webots_mcp.plotting.trials import plot_trials

    sheet = Sheet(image_format=image_format_of(file))

    def draw(recording: RecordingAccess, set_id: int) -> None:
        with recording.reader() as connection:
            picture = plot_trials(connection, set_id, sheet=sheet)
        with redirect_stdout(sys.stderr):  # stdout may be JSON
            write_picture(file, picture)

    return draw


def _set_of(recording: RecordingAccess, plan: WorldPlan, options: TrialOptions) -> int:
    """Return the set that was begun with this plan, or a new one."""
    from webots_mcp.store.trial_sets import create_trial_set, find_trial_set

    text = _text_of(plan, options)
    with recording.writer() as connection:
        known = None if options.again else find_trial_set(connection, text)
        return known or create_trial_set(connection, text, plan.trials)


def _begun_set(
    recording: RecordingAccess, file: Path, plan: WorldPlan, options: TrialOptions
) -> int:
    """Return the set that was begun with this plan.

    Raises:
        NothingRecordedError: There is none.
    """
    from webots_mcp.store.trial_sets import find_trial_set

    with recording.reader() as connection:
        known = find_trial_set(connection, _text_of(plan, options))
    if known is None:
        raise NothingRecordedError(f"no trials of {file} were begun with these options")
    return known


def _text_of(plan: WorldPlan, options: TrialOptions) -> str:
    """By which a set is found again."""
    return json.dumps({"stand_in": options.stand_in, **json.loads(plan.text)}, sort_keys=True)


class _TrialProgress:
    """A line on stderr for each trial that is over, and for each set that takes the lead."""

    def __init__(self, recording: RecordingAccess, set_id: int, plan: WorldPlan) -> None:
        from webots_mcp.store.trial_sets import trials_of

        with recording.reader() as connection:
            known = trials_of(connection, set_id)
        self._recording, self._set_id, self._plan = recording, set_id, plan
        self._of, self._over = plan.trial_count, sum(each.is_over for each in known)
        self._leader: dict[str, Any] | None = None
        self._ranked_s = 0.0
        if self._over:
            print(f"trial set {set_id}: {self._over} of {self._of} trials were done before",
                  file=sys.stderr)  # fmt: skip

    def tell(self, trial: TrialRecord, result: TrialResult) -> None:
        """That a trial is over, and what came of it."""
        self._over += 1
        came = text_of(result.score) if result.status == "done" else result.error
        word = {"done": "score", "failed": "failed:", "pruned": "pruned:"}[result.status]
        came = f"{word} {came}"
        said = f"{self._over}/{self._of}  "
        if trial.values:
            said += f"{text_of(trial.values)}: {came}"
        else:  # the same again, which no score ranks
            said += "over" if result.status == "done" else came
        print(said, file=sys.stderr, flush=True)
        is_due = time.monotonic() >= self._ranked_s + 1.0
        if trial.values and is_due and self._over < self._of:
            self._tell_leader()
            self._ranked_s = time.monotonic()

    def _tell_leader(self) -> None:
        from webots_mcp.store.trial_sets import ranking_of, trials_of

        with self._recording.reader() as connection:
            first = ranking_of(trials_of(connection, self._set_id), self._plan.best).sets[0]
        if first.score is not None and first.parameters != self._leader:
            self._leader = first.parameters
            said = f"{text_of(first.parameters)}, mean {text_of(first.score.mean)}"
            print(f"      best so far: {said}", file=sys.stderr, flush=True)


def _show_trials(
    recording: RecordingAccess, set_id: int, plan: WorldPlan, *, as_json: bool
) -> None:
    from webots_mcp.judging.divergence import repeats_noted
    from webots_mcp.judging.run_score import unseen
    from webots_mcp.store.trial_sets import ranking_of, trials_of

    with recording.reader() as connection:
        found = trials_of(connection, set_id)
        notes = unseen(connection, (each.run_id for each in found if each.score is not None))
        notes = [*repeats_noted(connection, set_id), *notes]
    ranking = ranking_of(found, plan.best)
    runs = {each.number: each.run_id for each in found}
    if as_json:
        print(
            json.dumps({"trial_set_id": set_id, **_as_json(ranking), "runs": runs, "notes": notes})
        )
        return
    print_table(
        ("rank", "parameters", "mean", "least", "greatest", "scores", "pruned", "failed", "why"),
        [_row(number, each) for number, each in enumerate(ranking.sets, 1)],
    )
    ids = [each.run_id for each in found if each.run_id is not None]
    where = f"runs {min(ids)} to {max(ids)}" if ids else "no run was recorded"
    print_notes([ranking.verdict, f"trial set {set_id}, {where}; score: {plan.score}", *notes])


def _row(number: int, ranked: Any) -> list[Any]:
    spread = ranked.score or (None, None, None)
    failures = ranked.failures
    return [number, ranked.parameters, *spread, len(ranked.scores), ranked.pruned or None,
            len(failures) or None, failures[0] if failures else None]  # fmt: skip


def _as_json(ranking: Ranking) -> dict[str, Any]:
    sets = [{**e._asdict(), "score": e.score and e.score._asdict()} for e in ranking.sets]
    return {**ranking._asdict(), "sets": sets, "noise": ranking.noise._asdict()}
