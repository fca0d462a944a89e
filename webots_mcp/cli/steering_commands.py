"""Define commands that steer a simulation and combine several questions, or use a part of one.

Everything that an assistant can do, a person can do: each is answered like the MCP tool.
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

from webots_mcp.cli.interrupts import ending_by_event
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
from webots_mcp.cli.recording_commands import write_picture
from webots_mcp.cli.terminal import clock_text, print_json, print_notes, print_table, text_of
from webots_mcp.cli.wording import as_typed
from webots_mcp.contract import BreakpointAction
from webots_mcp.errors import InvalidInputError, NothingRecordedError

if TYPE_CHECKING:
    from webots_mcp.analysis.summary import Ranking
    from webots_mcp.questions.declaration import Question
    from webots_mcp.steering.trial_plan import WorldPlan
    from webots_mcp.steering.trial_run import Simulators
    from webots_mcp.store.recording import RecordingAccess
    from webots_mcp.store.trial_sets import TrialRecord, TrialResult

_ROBOT: Final = ToRobot()
_WAITING: Final = Waiting()
_WEBOTS: Final = ToWebots()
_WHERE: Final = Where()
_UNTIL_DONE_S: Final = 1e9  # of wall time: Ctrl-C ends the branches


def pause(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Pause the simulation. Questions can still be asked."""
    _control("pause", asked, as_json=json)


def resume(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Resume a paused simulation in real time."""
    _control("resume", asked, as_json=json)


def step(
    steps: Annotated[
        int, Parameter("N", converter=whole_number, help="Number of steps. Default: 1.")
    ] = 1,
    /,
    *,
    asked: ToWebots = _WEBOTS,
    json: Json = False,
) -> None:
    """Run N steps of the controller's loop, then pause."""
    _control("step", asked, as_json=json, steps=steps)


def fast(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Run the simulation as fast as possible."""
    _control("fast", asked, as_json=json)


def reset(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Reset the simulation to its first state; a new run begins at time 0.

    Controllers are not restarted and keep their code. To restart them, use 'webots-mcp reload'.
    """
    _control("reset", asked, as_json=json)


def reload(*, asked: ToWebots = _WEBOTS, json: Json = False) -> None:
    """Reload the world and restart its controllers with their current code.

    Extern controllers stop and must be started again by hand.
    """
    _control("reload", asked, as_json=json)


def _control(command: str, asked: ToWebots, *, as_json: bool, **given: Any) -> None:
    from webots_mcp.questions.control_simulation import webots_simulation_control

    _show(webots_simulation_control, asked, as_json=as_json, command=command, **given)


def capture(
    reason: Annotated[str, Parameter("REASON", help="Reason, which is recorded as an event.")],
    /,
    *,
    asked: Waiting = _WAITING,
    json: Json = False,
) -> None:
    """Keep the last seconds of a running controller, and the next two, at full rate.

        webots-mcp capture "wheel slipped"

    Every call of publish() in this time becomes a row, even calls that the rate limit would skip.
    """
    from webots_mcp.questions.send_command import webots_send_command

    params = {"reason": reason}
    _show(webots_send_command, asked, as_json=json, action="keep", params=params)


def parameters(
    *settings: Annotated[
        str, Parameter("NAME=VALUE", help="Parameters to set; all or none are changed.")
    ],
    asked: Waiting = _WAITING,
    run_id: RunId = None,
    from_reset: Annotated[
        bool, Parameter("--from-reset", help="Set them at the next reset instead of now.")
    ] = False,
    json: Json = False,
) -> None:
    """Show the parameters that a controller declares, or set some while it runs.

    Values change together, between two steps. A reset keeps them; a reload restores those in the
    code.

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
        raise InvalidInputError(
            "--run shows the parameters of an earlier run, which cannot be changed. Leave --run "
            "out to set them in the current run."
        )
    when = "reset" if from_reset else "now"
    _show(webots_set_parameters, asked, as_json=json, values=settings, when=when)


def signals(
    *words: Annotated[
        str,
        Parameter(
            "PATTERN",
            help=r"Signals to list; '\*' means any text. Default: all. With --describe: "
            "FIELD=VALUE, such as quantity=speed.",
        ),
    ],
    describe: Annotated[
        str | None,
        Parameter("--describe", metavar="SIGNAL", help="Declare what this signal means."),
    ] = None,
    undo: Annotated[
        str | None,
        Parameter("--undo", metavar="SIGNAL", help="Remove the declaration of this signal."),
    ] = None,
    meanings: Annotated[
        bool,
        Parameter(
            "--meanings", negative=(), help="List the meaning of each signal, and its source."
        ),
    ] = False,
    limit: Annotated[
        Count, Parameter("-n", metavar="N", help="Maximum number of signals. Default: 100.")
    ] = 100,
    cursor: Annotated[
        int | None,
        Parameter(
            "--after",
            metavar="CURSOR",
            converter=whole_number,
            help="Cursor of the previous answer, to continue it.",
        ),
    ] = None,
    run_id: RunId = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """List the signals of a run: kind, last value, range, missing values, meaning and its source.

        webots-mcp signals 'front*'

    Use --describe for signals whose meaning is unknown or wrong. It applies to past runs too. The
    fields are quantity, role, unit, target_of, same_as, side, low and high; 'webots-mcp help
    meanings' lists their values.

        webots-mcp signals --describe motors.left quantity='wheel speed'
    """
    from webots_mcp.questions.describe_signals import webots_describe_signals, webots_list_meanings
    from webots_mcp.questions.query_history import webots_list_signals

    if describe is not None and undo is not None:
        raise InvalidInputError("--describe and --undo exclude each other. Give one of them.")
    if describe is not None:
        said = _fields_of(words)
        return _show(webots_describe_signals, asked, as_json=json, signals=[describe], **said)
    if undo is not None and words:
        raise InvalidInputError(f"--undo takes one signal. Leave out {words[0]!r}.")
    if undo is not None:
        return _show(webots_describe_signals, asked, as_json=json, signals=[undo], undo=True)
    if meanings:
        names = [*words] or None
        return _show(webots_list_meanings, asked, as_json=json, signals=names)
    if len(words) > 1:
        raise InvalidInputError(
            f"Only one pattern is allowed, and {words[1]!r} is a second one. Put the pattern in "
            "quotes, so that the shell does not expand it."
        )
    given = {"pattern": words[0]} if words else {}
    given |= {"limit": limit, "cursor": cursor, "run_id": run_id}
    _show(webots_list_signals, asked, as_json=json, **given)


def _fields_of(words: tuple[str, ...]) -> dict[str, Any]:
    """Return what is said of a signal, of texts FIELD=VALUE; only limits are numbers."""
    from webots_mcp.cli.options import settings_of
    from webots_mcp.signals.meaning import MEANING_FIELDS

    limits = ("low", "high")
    kinds = dict.fromkeys((each for each in MEANING_FIELDS if each not in limits), "str")
    said = settings_of(words, kinds)
    if not said:
        raise InvalidInputError("--describe needs FIELD=VALUE, such as quantity=speed")
    if unknown := [name for name in said if name not in MEANING_FIELDS]:
        fields = ", ".join(MEANING_FIELDS)
        raise InvalidInputError(f"unknown field {unknown[0]!r:.80}. Fields: {fields}")
    return said


def breakpoint_(
    condition: Annotated[
        str | None, Parameter("CONDITION", help="Condition, such as 'front_m < 0.1 for 0.5'.")
    ] = None,
    /,
    *,
    action: Annotated[
        BreakpointAction, Parameter("--action", help="What to do at a hit. Default: pause.")
    ] = "pause",
    after_hits: Annotated[
        Count,
        Parameter("--after-hits", metavar="N", help="Act from the Nth hit of a run. Default: 1."),
    ] = 1,
    breakpoint_id: Annotated[
        Id | None, Parameter("--remove", metavar="ID", help="Remove the breakpoint with this id.")
    ] = None,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Set a breakpoint, which pauses or logs when a condition begins to hold, or list them.

        webots-mcp breakpoint 'front_m < 0.1' --action log

    Without CONDITION it lists the breakpoints. Every published state is checked. Breakpoints stay
    armed after a reset or reload.
    """
    from webots_mcp.questions import set_breakpoints

    if condition is not None and breakpoint_id is not None:
        raise InvalidInputError("A condition and --remove exclude each other. Give one of them.")
    if breakpoint_id is not None:
        remove = set_breakpoints.webots_remove_breakpoint
        return _show(remove, asked, as_json=json, breakpoint_id=breakpoint_id)
    if condition is None:
        return _show(set_breakpoints.webots_list_breakpoints, asked, as_json=json)
    given = {"condition": condition, "action": action, "after_hits": after_hits}
    _show(set_breakpoints.webots_breakpoint, asked, as_json=json, **given)


def field(
    path: Annotated[
        str, Parameter("PATH", help="Node or field: ROVER, ROVER.translation, BALL.physics.mass.")
    ],
    value: Annotated[
        str | None,
        Parameter(
            "VALUE",
            help="New value, such as '[0, 1, 0.04]', 0.5, true or a text.",
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
            help="First entry to show of a long list. Default: 0.",
        ),
    ] = None,
    stop: Annotated[
        bool, Parameter("--stop", help="Also set the speed of the node to zero.")
    ] = False,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Show a field of the scene tree or all fields of a node, or set a field.

    A change is recorded as an event. A reset restores the old value.

        webots-mcp field ROVER.translation '[0, 1, 0.04]'
    """
    from webots_mcp.questions.edit_scene import webots_get_field, webots_set_field

    if stop and value is None:
        raise InvalidInputError("--stop goes with a VALUE to set. Add it, or leave --stop out.")
    if value is None:
        return _show(webots_get_field, asked, as_json=json, path=path, start=start)
    _show(webots_set_field, asked, as_json=json, path=path, value=value, stop=stop)


def _show(question: Question, asked: ToRobot, *, as_json: bool, **given: Any) -> None:
    """Ask a question with the options that it has, and print the answer."""
    from webots_mcp.cli.question_commands import ask_and_show

    of_options = {name: value for name, value in vars(asked).items() if _has(question, name)}
    ask_and_show(question, of_options | given, asked, as_json=as_json)


def _has(question: Question, argument: str) -> bool:
    return any(each.name == argument for each in question.parameters)


def audit(
    *,
    number: Annotated[
        Count, Parameter("-n", metavar="N", help="Number of requests. Default: 20.")
    ] = 20,
    refused: Annotated[
        bool, Parameter("--refused", negative=(), help="Only requests that a rule refused.")
    ] = False,
    recorded: Where = HERE,
    json: Json = False,
) -> None:
    """List requests that change something: who asked, for what, and the outcome; newest first.

    Covers MCP clients, this command line and the page. These rows are never deleted. For rules that
    refuse requests see 'webots-mcp help policy'.
    """
    from webots_mcp.store.requests import newest_requests

    with recorded.reader() as connection:
        found = newest_requests(connection, number, refused=refused)
    if json:
        return print_json({"requests": found})
    if not found:
        return print("No request was refused." if refused else "No request was made yet.")
    what = "refused requests" if refused else "requests"
    print(f"The newest {len(found)} {what}, newest first:")
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
    reported = [request["id"], when, request["sim_time_s"], by, request["tool"]]
    return [*reported, request["arguments"] or None, outcome, commands or None]


# -- branches of a live run ------------------------------------------------------------------------


@Parameter(name="*")
@dataclass(frozen=True)
class BranchOptions:
    """When a branch ends, how it is scored, and where it runs."""

    score: Annotated[
        str,
        Parameter("--score", metavar="FORMULA", help="Formula of a branch's score: 'max(pose.x)'."),
    ]
    for_s: Annotated[
        float | None, Parameter("--for", metavar="S", help="Simulated seconds of each branch.")
    ] = None
    until: Annotated[
        str | None,
        Parameter("--until", metavar="CONDITION", help="Condition that ends a branch earlier."),
    ] = None
    prune: Annotated[
        str | None,
        Parameter(
            "--prune", metavar="CONDITION", help="Condition that ends a branch without a score."
        ),
    ] = None
    best: Annotated[
        Literal["highest", "lowest"],
        Parameter("--best", help="Which score is best. Default: highest."),
    ] = "highest"
    repeats: Annotated[
        Count, Parameter("--repeats", metavar="N", help="Branches of each set. Default: 1.")
    ] = 1
    jobs: Annotated[
        Count, Parameter("--jobs", metavar="N", help="Maximum number of simulators. Default: 1.")
    ] = 1
    stand_in: Annotated[
        bool, Parameter("--stand-in", help="Use the stand-in simulator, not Webots.")
    ] = False


def branch(
    *settings: Annotated[
        str, Parameter("NAME=V1,V2,...", help="Values to try; every combination of several names.")
    ],
    options: BranchOptions,
    asked: ToRobot = _ROBOT,
    json: Json = False,
) -> None:
    """Try parameters from this moment of the simulation on, each in a simulator of its own.

        webots-mcp branch speed=2,4,6 --for 5 --score 'max(pose.x)'

    The world is saved while it stands still, and each branch continues a copy of it. Branch 0
    changes nothing: it shows when branches part from the original by themselves. See 'webots-mcp
    help branches'.
    """
    from webots_mcp.cli.options import value_of
    from webots_mcp.questions.branch_run import webots_branch_run

    if not settings:
        raise InvalidInputError("No parameter to change. Give NAME=V1,V2, such as speed=2,4,6.")
    grid: dict[str, list[Any]] = {}
    for text in settings:
        name, equals, values = text.partition("=")
        if not (name and equals and values):
            raise InvalidInputError(f"{text!r} has no values. Write NAME=V1,V2, as in speed=2,4.")
        grid.setdefault(name, []).extend(value_of(each) for each in values.split(","))
    given = {**vars(options), "parameters": grid, "timeout_wall_s": _UNTIL_DONE_S}
    _show(webots_branch_run, asked, as_json=json, **given)


# -- trials of a plan file, each in a simulator of its own -----------------------------------------


@Parameter(name="*")
@dataclass(frozen=True)
class TrialOptions:
    """Where and how the trials run."""

    jobs: Annotated[
        Count | None,
        Parameter(
            "--jobs",
            metavar="N",
            help="Maximum number of trials at once, each in its own simulator. Default: 1, or with "
            "--scheduler as many as its workers can run.",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        Parameter(
            "--scheduler",
            metavar="ADDRESS",
            help="Run trials on the workers of this Dask cluster, such as tcp://HOST:8786.",
        ),
    ] = None
    ship_to: Annotated[
        str | None,
        Parameter(
            "--ship-to",
            metavar="URL",
            help="With --scheduler: pool through which large recordings are sent, and kept.",
        ),
    ] = None
    stand_in: Annotated[
        bool, Parameter("--stand-in", help="Use the stand-in simulator, not Webots.")
    ] = False
    again: Annotated[
        bool,
        Parameter("--again", help="Start over, even if all trials of the plan are done."),
    ] = False


_DEFAULTS: Final = TrialOptions()


def trials(
    plan: Annotated[
        Path, Parameter("PLAN", help="Plan file (.toml); see 'webots-mcp help trials'.")
    ],
    /,
    *,
    options: TrialOptions = _DEFAULTS,
    search: Annotated[
        Literal["tpe", "random"] | None,
        Parameter(
            "--search",
            metavar="SAMPLER",
            help="Sampler that searches the [ranges] of the plan with Optuna.",
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        Parameter(
            "--plot",
            metavar="FILE",
            help="Also draw the scores over the parameters: .png or .svg.",
        ),
    ] = None,
    so_far: Annotated[
        bool,
        Parameter(
            "--so-far",
            help="Only show the trials that are done, even while another process runs them.",
        ),
    ] = False,
    recorded: Where = _WHERE,
    json: Json = False,
) -> None:
    """Run a plan of trials: one run per set of parameters, scored and ranked.

        webots-mcp trials plan.toml --jobs 4 --search tpe

    Each trial runs in its own simulator and data folder. Its run is then merged into the recording
    and can be queried like any other run. After Ctrl-C, the same command continues where it
    stopped.

    With --scheduler, start each Dask worker with the resource simulator=1:

        dask worker tcp://HOST:8786 --resources simulator=1 --nthreads 1
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
    """Run the remaining trials of the plan's set. Return its id."""
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
    """Return where the trials run; the program is checked first."""
    from webots_mcp.steering.trial_run import LocalSimulators, stand_in, webots

    if options.scheduler is not None:
        return _cluster(options, plan)
    if options.ship_to is not None:
        raise InvalidInputError(
            "--ship-to applies only to --scheduler: trials on this machine need no pool. Leave it "
            "out."
        )
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
    """Return a function that draws the requested picture, or None."""
    if file is None:
        return None
    from webots_mcp.plotting.canvas import Sheet, image_format_of
    from webots_mcp.plotting.trials import plot_trials

    sheet = Sheet(image_format=image_format_of(file))

    def draw(recording: RecordingAccess, set_id: int) -> None:
        with recording.reader() as connection:
            picture = plot_trials(connection, set_id, sheet=sheet)
        with redirect_stdout(sys.stderr):  # stdout may hold JSON
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
        NothingRecordedError: No set was begun with this plan.
    """
    from webots_mcp.store.trial_sets import find_trial_set

    with recording.reader() as connection:
        known = find_trial_set(connection, _text_of(plan, options))
    if known is None:
        raise NothingRecordedError(
            f"No trials of {file} were started with these options. Start them with 'webots-mcp "
            f"trials {file}'."
        )
    return known


def _text_of(plan: WorldPlan, options: TrialOptions) -> str:
    """Return the text by which a set is found again."""
    return json.dumps({"stand_in": options.stand_in, **json.loads(plan.text)}, sort_keys=True)


class _TrialProgress:
    """Print a line on stderr for each finished trial, and for each set that takes the lead."""

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
        """Report a finished trial and its outcome."""
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
    print(as_typed(ranking.verdict))
    print_table(
        ("rank", "parameters", "mean", "min", "max", "scores", "pruned", "failed", "why"),
        [_row(number, each) for number, each in enumerate(ranking.sets, 1)],
    )
    ids = [each.run_id for each in found if each.run_id is not None]
    where = f"runs {min(ids)} to {max(ids)}" if ids else "no run was recorded"
    print_notes([f"trial set {set_id}, {where}; score: {plan.score}", *notes])


def _row(number: int, ranked: Any) -> list[Any]:
    spread = ranked.score or (None, None, None)
    failures = ranked.failures
    return [number, ranked.parameters, *spread, len(ranked.scores), ranked.pruned or None,
            len(failures) or None, failures[0] if failures else None]  # fmt: skip


def _as_json(ranking: Ranking) -> dict[str, Any]:
    sets = [{**e._asdict(), "score": e.score and e.score._asdict()} for e in ranking.sets]
    return {**ranking._asdict(), "sets": sets, "noise": ranking.noise._asdict()}
