"""Trials of a plan file, each in a simulator of its own."""

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

from webots_mcp.cli.ending import ending_by_event
from webots_mcp.cli.looking import write_picture
from webots_mcp.cli.recordings import Json, Where
from webots_mcp.cli.rendering import print_notes, print_table, text_of
from webots_mcp.cli.values import Count, Parameter
from webots_mcp.errors import InvalidInputError, NothingRecordedError

if TYPE_CHECKING:
    from webots_mcp.store.analysis.spread import Ranking
    from webots_mcp.store.recording import Recording
    from webots_mcp.trials.plan import WorldPlan
    from webots_mcp.trials.trial_run import Simulators


_RANK_EVERY_S: Final = 1.0
_WORDS: Final = {"done": "score", "failed": "failed:", "pruned": "pruned:"}


@Parameter(name="*")
@dataclass(frozen=True)
class _Options:
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


_DEFAULTS: Final = _Options()
_WHERE: Final = Where()


def trials(
    plan: Annotated[Path, Parameter("PLAN", help="A .toml file: see docs/trials.md.")],
    /,
    *,
    options: _Options = _DEFAULTS,
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
    from webots_mcp.trials.plan import read_plan

    found = read_plan(plan, search)
    draw = _picture_of(plot)
    if so_far:
        recording = recorded.recording()
        set_id = _begun_set(recording, plan, found, options)
    else:
        recording = recorded.recording(read_only=False)
        set_id = _run(recording, found, options)
    _show(recording, set_id, found, as_json=json)
    if draw is not None:
        draw(recording, set_id)


def _run(recording: Recording, plan: WorldPlan, options: _Options) -> int:
    """Run what is left of the plan's set; returns its id."""
    from webots_mcp.trials.set_runner import SetRun, require_optuna, run_trials

    if plan.search:
        require_optuna()
    with _simulators(options, plan) as simulators:
        recording.create()
        set_id = _set_of(recording, plan, options)
        set_run = SetRun(recording, plan, simulators, threading.Event())
        with ending_by_event(set_run.stopping):
            run_trials(set_run, set_id, _Progress(recording, set_id, plan).tell)
    return set_id


def _simulators(options: _Options, plan: WorldPlan) -> AbstractContextManager[Simulators]:
    """Where the trials run; that there is such a program is seen before anything is written."""
    from webots_mcp.trials.trial_run import LocalSimulators, stand_in, webots

    if options.scheduler is not None:
        return _cluster(options, plan)
    if options.ship_to is not None:
        raise InvalidInputError("--ship-to is for --scheduler: what runs here is merged as it is")
    command_of = stand_in if options.stand_in else webots
    command_of(plan.world)
    return nullcontext(LocalSimulators(command_of, options.jobs or 1))


@contextmanager
def _cluster(options: _Options, plan: WorldPlan) -> Generator[Simulators]:
    from webots_mcp.plugins import cluster_offered, load

    with load(cluster_offered().simulators)(
        options.scheduler,
        plan,
        is_stand_in=options.stand_in,
        most=options.jobs,
        ship_to=options.ship_to,
    ) as simulators:
        for note in simulators.notes:
            print(f"webots-mcp: {note}", file=sys.stderr)
        yield simulators


def _picture_of(file: Path | None) -> Callable[[Recording, int], None] | None:
    """What draws the picture that is asked for; None where none is."""
    if file is None:
        return None
    from webots_mcp.plotting import Sheet, image_format_of, plot_trials

    sheet = Sheet(image_format=image_format_of(file))

    def draw(recording: Recording, set_id: int) -> None:
        with recording.reader() as connection:
            picture = plot_trials(connection, set_id, sheet=sheet)
        with redirect_stdout(sys.stderr):  # stdout may be JSON
            write_picture(file, picture)

    return draw


def _set_of(recording: Recording, plan: WorldPlan, options: _Options) -> int:
    """The set that was begun with this plan, or a new one."""
    from webots_mcp.store.parameters import create_trial_set, find_trial_set

    text = _text_of(plan, options)
    with recording.writer() as connection:
        known = None if options.again else find_trial_set(connection, text)
        return known or create_trial_set(connection, text, plan.trials)


def _begun_set(recording: Recording, file: Path, plan: WorldPlan, options: _Options) -> int:
    """The set that was begun with this plan.

    Raises:
        NothingRecordedError: There is none.
    """
    from webots_mcp.store.parameters import find_trial_set

    with recording.reader() as connection:
        known = find_trial_set(connection, _text_of(plan, options))
    if known is None:
        raise NothingRecordedError(f"no trials of {file} were begun with these options")
    return known


def _text_of(plan: WorldPlan, options: _Options) -> str:
    """By which a set is found again."""
    return json.dumps({"stand_in": options.stand_in, **json.loads(plan.text)}, sort_keys=True)


class _Progress:
    """A line on stderr for each trial that is over, and for each set that takes the lead."""

    def __init__(self, recording: Recording, set_id: int, plan: WorldPlan) -> None:
        from webots_mcp.store.parameters import trials_of

        with recording.reader() as connection:
            known = trials_of(connection, set_id)
        self._recording, self._set_id, self._plan = recording, set_id, plan
        self._of, self._over = plan.trial_count, sum(each.is_over for each in known)
        self._leader: dict[str, Any] | None = None
        self._ranked_s = 0.0
        if self._over:
            print(f"trial set {set_id}: {self._over} of {self._of} trials were done before",
                  file=sys.stderr)  # fmt: skip

    def tell(self, trial: Trial, result: Result) -> None:
        """That a trial is over, and what came of it."""
        self._over += 1
        came = text_of(result.score) if result.status == "done" else result.error
        came = f"{_WORDS[result.status]} {came}"
        said = f"{self._over}/{self._of}  {text_of(trial.values)}: {came}"
        print(said, file=sys.stderr, flush=True)
        if time.monotonic() >= self._ranked_s + _RANK_EVERY_S and self._over < self._of:
            self._tell_leader()
            self._ranked_s = time.monotonic()

    def _tell_leader(self) -> None:
        from webots_mcp.store.parameters import ranking_of, trials_of

        with self._recording.reader() as connection:
            first = ranking_of(trials_of(connection, self._set_id), self._plan.best).sets[0]
        if first.score is not None and first.parameters != self._leader:
            self._leader = first.parameters
            said = f"{text_of(first.parameters)}, mean {text_of(first.score.mean)}"
            print(f"      best so far: {said}", file=sys.stderr, flush=True)


def _show(recording: Recording, set_id: int, plan: WorldPlan, *, as_json: bool) -> None:
    from webots_mcp.store.questions.outcomes import unseen
    from webots_mcp.store.trials import ranking_of, trials_of

    with recording.reader() as connection:
        found = trials_of(connection, set_id)
        notes = unseen(connection, (each.run_id for each in found if each.score is not None))
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
    sets = [
        {**each._asdict(), "score": each.score and each.score._asdict()} for each in ranking.sets
    ]
    return {**ranking._asdict(), "sets": sets, "noise": ranking.noise._asdict()}
