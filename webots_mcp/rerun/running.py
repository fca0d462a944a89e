"""Runs the old and the new code of a controller on the tape of a run, and says where they part."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.contract import DATA_DIR_VARIABLE, PARAMETERS_VARIABLE
from webots_mcp.database.connection import connect
from webots_mcp.database.location import Database
from webots_mcp.database.tapes.source_files import (
    files_near,
    read_sources,
    relative_source,
    root_of,
    unpack_sources,
)
from webots_mcp.database.tapes.tape import Tape, open_tape, tape_files
from webots_mcp.database.tapes.tape_wanted import TAPE_VARIABLE
from webots_mcp.errors import (
    CommandRefusedError,
    InvalidInputError,
    NothingRecordedError,
    UnknownRunError,
)
from webots_mcp.rerun import likely_cause
from webots_mcp.rerun.deciding_line import TracedLine, find_deciding_line
from webots_mcp.rerun.likely_cause import Witness, dated_lines, outside_lines
from webots_mcp.rerun.recorded_rows import make_tape, with_commands
from webots_mcp.rerun.replay_process import ReplayJob, ReplayResult, result_of_stack

STALL_S: Final = 60.0  # of wall time without a step, after which a replay is ended
LIMIT_S: Final = 3600.0  # of wall time, for each replay
_GRACE_S: Final = 5.0  # after which a replay that did not end itself is killed
_MOST_OUTPUT_CHARACTERS: Final = 2000
_PROCESS: Final = "webots_mcp.rerun.replay_process"
_PACKAGE_PARENT: Final = Path(__file__).parents[2]
HOW_TO_RECORD: Final = (
    "Record with a tape: 'webots-mcp launch WORLD --tape', WEBOTS_MCP_TAPE=1 in the environment of "
    "the controller, or the line 'tape = true' at the top of webots-mcp.toml"
)
_OF_RUN: Final = (
    "SELECT s.uuid, (SELECT count(*) FROM run r WHERE r.session_id = s.id AND r.id < run.id), "
    "run.uuid FROM run JOIN session s ON s.id = run.session_id WHERE run.id = ?"
)


class MadeFolder:
    """A folder for a tape that is made; it is removed when nobody uses it any more."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="webots-mcp-rows-"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class TapedRun(NamedTuple):
    """A run that has a tape.

    Attributes:
        run_id: Its id.
        tape: The tape of its session.
        number: The run's number in the session, from 0.
        is_imported: The tape, and so the recorded code, came from elsewhere.
        basis: What it rests on, where it was made of recorded rows; None of a recorded tape.
        folder: Holds a tape that was made, as long as this exists.
    """

    run_id: int
    tape: Tape
    number: int
    is_imported: bool = False
    basis: str | None = None
    folder: MadeFolder | None = None


@dataclass
class Rerun:
    """What came of running new code on an old run.

    Attributes:
        outcome: `equal`, `differs`, `not repeatable` (a version does not repeat itself),
            `not on the tape` (something was asked that the old run did not ask), `ended early`,
            or `timed out`.
        run_id: The run.
        file: The new version.
        rounds: Rounds of the loop in which all commands are equal.
        until_s: Simulation time up to which they are.
        of_rounds: Rounds of the old run that were replayed.
        first_differences: What differs in the first round that differs.
        deciding_line: The line that decides differently.
        unrecorded: What was asked.
        likely_causes: Why a version does not repeat itself; of a difference, chance in new code.
        exception: The exception that ended the new version.
        place: Where that was, or where the unrecorded question was asked.
        began_late: The tape began after the robot was made.
        is_unchanged: The new version is the old one.
        of_new_code: It is the new version that does not repeat itself.
        ends_with_tape: The tape ends before the run does: it was full, or its writer was killed.
        goes_on: The old version ended by itself there, and the new one asked for another step.
        in_earlier_run: The replay ended in an earlier run of the same process.
        rounds_per_s: Rounds replayed in a second of processor time.
        basis: What it rests on, where the run has no tape.
    """

    outcome: str
    run_id: int
    file: str
    rounds: int
    until_s: float
    of_rounds: int = 0
    first_differences: list[str] = field(default_factory=list[str])
    deciding_line: dict[str, Any] | None = None
    unrecorded: str | None = None
    likely_causes: list[str] = field(default_factory=list[str])
    exception: str | None = None
    place: str | None = None
    began_late: bool = False
    is_unchanged: bool = False
    of_new_code: bool = False
    ends_with_tape: bool = False
    goes_on: bool = False
    in_earlier_run: bool = False
    rounds_per_s: float = 0.0
    basis: str | None = None

    @property
    def text(self) -> str:
        """The outcome in a sentence."""
        return f"{self._outcome_text()} ({self.basis})" if self.basis else self._outcome_text()

    def _outcome_text(self) -> str:
        until = f"{self.until_s:.3f} s"
        if self.in_earlier_run:
            until += " of an earlier run of the same process"
        causes = "; ".join(self.likely_causes)
        if self.outcome == "not repeatable":
            whose = "The new code" if self.of_new_code else "Your code"
            return (
                f"{whose} does not repeat itself from {until} on, so nothing can be said about "
                f"an edit. Likely cause: {causes or 'not known'}"
            )
        noun = "round" if self.rounds == 1 else "rounds"
        equal = f"equal for {self.rounds:,} {noun} until {until}"
        if self.outcome == "equal":
            version = "the unchanged code" if self.is_unchanged else "the new code"
            ended = f"; then it ended by {self.exception} at {self.place}" if self.exception else ""
            if self.ends_with_tape and not self.basis:
                ended += "; the tape ends there"
            if self.goes_on:
                ended += "; then it goes on, where the recorded code ended"
            return f"{equal}: {version} commands the same to the last digit{ended}"
        if self.outcome == "differs":
            line = self.deciding_line
            decided = f"; decided at {line['place']}" if line else ""
            chance = f"; this may be chance: {causes}" if causes else ""
            return f"{equal}; then {'; '.join(self.first_differences)}{decided}{chance}"
        place = f" ({self.place})" if self.place else ""
        if self.outcome == "not on the tape":
            return f"{equal}; then the replay ends{place}: {self.unrecorded}"
        if self.outcome == "timed out":
            return f"{equal}; then the time for the replay was over{place}"
        why = f" by {self.exception}" if self.exception else ""
        return f"{equal}; then the new code ended{why}{place}, while the old one went on"


def find_taped_run(database: Database, data_dir: Path, run_id: int) -> TapedRun:
    """Return the tape of a run; where it has none, one that is made of its rows.

    Raises:
        UnknownRunError: There is no such run.
        NothingRecordedError: It has no tape, and its rows do not suffice; the text says what is
            missing, and how to record a tape.
        InvalidInputError: The tape is damaged.
    """
    with closing(connect(database, "reader")) as connection:
        row = connection.execute(_OF_RUN, (run_id,)).fetchone()
    if row is None:
        raise UnknownRunError(f"There is no run {run_id}. 'webots-mcp runs' lists them.")
    own, imported = tape_files(data_dir, str(row[0]))
    file = own if own.is_file() else imported
    if not file.is_file():
        folder = MadeFolder()
        try:
            made = make_tape(database, data_dir, run_id, folder.path)
        except NothingRecordedError as error:
            raise NothingRecordedError(f"{error} {HOW_TO_RECORD}.") from None
        return TapedRun(run_id, made.tape, 0, basis=made.basis, folder=folder)
    tape = open_tape(file)
    number = tape.number_of_run(str(row[2]))
    # Earlier runs of the session may be deleted, or were not exported.
    number = int(row[1]) if number is None else number
    return TapedRun(run_id, tape, number, is_imported=file != own)


def require_own_tape(taped: TapedRun, *, trusted: bool) -> None:
    """Refuse to run code that came with an import, unless the person trusts it.

    Raises:
        CommandRefusedError: The tape was imported.
    """
    if taped.is_imported and not trusted:
        raise CommandRefusedError(
            f"The tape of run {taped.run_id} was imported, and its recorded code would run on this "
            "machine. If you trust where it came from, a person can run it with "
            f"'webots-mcp rerun {taped.run_id} FILE --trust'."
        )


def newest_taped_run(database: Database, data_dir: Path) -> int:
    """Return the newest run that has a tape.

    Raises:
        NothingRecordedError: None has.
    """
    with closing(connect(database, "reader")) as connection:
        rows = connection.execute(
            "SELECT run.id, s.uuid FROM run JOIN session s ON s.id = run.session_id "
            "ORDER BY run.id DESC"
        )
        for run_id, uuid in rows:
            if any(each.is_file() for each in tape_files(data_dir, str(uuid))):
                return int(run_id)
    raise NothingRecordedError(f"No run has a tape. {HOW_TO_RECORD}.")


def newest_run(database: Database, data_dir: Path) -> int:
    """Return the newest run that has a tape, else the newest one, whose rows may suffice.

    Raises:
        NothingRecordedError: No run is recorded.
    """
    try:
        return newest_taped_run(database, data_dir)
    except NothingRecordedError:
        with closing(connect(database, "reader")) as connection:
            (newest,) = connection.execute("SELECT max(id) FROM run").fetchone()
        if newest is None:
            raise
        return int(newest)


def current_file(taped: TapedRun) -> Path:
    """Return the controller of a run, as it is on disk now.

    Raises:
        InvalidInputError: It is not known, or not there any more.
    """
    head = taped.tape.head
    named = head.get("controller")
    file = Path(head["project"]) / str(named)
    if named is None or not file.is_file():
        raise InvalidInputError(
            f"The controller of run {taped.run_id} is not at {file} any more. Name the FILE to run."
        )
    return file


def require_own(file: Path, project: Path) -> Path:
    """Return the full path of a controller of a project; refuse any other file.

    Raises:
        InvalidInputError: It is missing, is not Python, or lies outside of the project.
    """
    full = file.resolve()
    if not full.is_file():
        raise InvalidInputError(f"There is no file {file}.")
    if full.suffix != ".py":
        raise InvalidInputError(f"{file} is not Python: only Python controllers can be run again.")
    if not full.is_relative_to(project.resolve()):
        raise InvalidInputError(
            f"{file} lies outside of the project {project}. Only its controllers are run."
        )
    return full


class Replays:
    """Replays of one run, in processes of their own and in folders that are removed.

    Args:
        taped: The run.
        until_s: Simulation time at which each replay ends.
        limit_s: Wall time for each replay.
        stall_s: Wall time without a step after which a replay is ended.
    """

    def __init__(
        self, taped: TapedRun, until_s: float | None, limit_s: float, stall_s: float
    ) -> None:
        self._stall_s = min(stall_s, limit_s)
        self._taped = taped
        self._until_s = until_s
        self._limit_s = limit_s
        self._folder = tempfile.TemporaryDirectory(prefix="webots-mcp-rerun-")
        self._count = 0
        self.old_root = Path(self._folder.name).resolve() / "old"
        self.old_sources = taped.tape.sources()
        self.old_root.mkdir()
        unpack_sources(self.old_sources, self.old_root, Path(taped.tape.head["project"]))

    def __enter__(self) -> Replays:
        return self

    def __exit__(self, *_: object) -> None:
        self._folder.cleanup()

    @property
    def old_file(self) -> Path:
        """The controller as it was.

        Raises:
            NothingRecordedError: The tape does not hold it.
        """
        named = self._taped.tape.head.get("controller")
        if named is None or named not in self.old_sources:
            raise NothingRecordedError(
                f"The tape of run {self._taped.run_id} does not hold the controller's source: the "
                "process had no main file, or ended before its first step."
            )
        return self.old_root / named

    def run(self, file: Path, root: Path, *, shows: bool = False, **asked: Any) -> ReplayResult:
        """Run a version on the tape.

        Args:
            file: The controller.
            root: The folder of its project.
            shows: Whether it uses this terminal, as a debugger does.
            asked: Further attributes of the job.

        Raises:
            InvalidInputError: The process could not run it; the text has what it printed.
        """
        self._count += 1
        folder = Path(self._folder.name) / str(self._count)
        (folder / "data").mkdir(parents=True)
        job = ReplayJob(
            str(self._taped.tape.file), str(file), str(root), str(file.parent),
            str(folder / "data"), str(folder / "result.json"), self._taped.number, self._until_s,
            self._stall_s, self._limit_s, **asked,
        )  # fmt: skip
        (folder / "job.json").write_text(json.dumps(asdict(job)), "utf-8")
        output = self._call(folder, shows=shows)
        try:
            return ReplayResult(**json.loads((folder / "result.json").read_text("utf-8")))
        except FileNotFoundError:
            if (ended := result_of_stack(folder, root)) is not None:
                return ended
            said = output[-_MOST_OUTPUT_CHARACTERS:].strip() or "it printed nothing"
            raise InvalidInputError(f"{file} could not be replayed: {said}") from None

    def with_hash_seed(self, seed: str) -> ReplayResult:
        """Run the old version with a seed of Python's hashes, which decides the order of sets."""
        head = self._taped.tape.head
        used, head["hash_seed"] = head["hash_seed"], seed
        try:
            return self.run(self.old_file, self.old_root)
        finally:
            head["hash_seed"] = used

    def _call(self, folder: Path, *, shows: bool) -> str:
        head = self._taped.tape.head
        command = [self._interpreter(head), "-m", _PROCESS, str(folder / "job.json")]
        environment = _environment(head, folder / "data")
        if shows:
            subprocess.run(command, env=environment, check=False)
            return ""
        with (folder / "output.txt").open("w+b") as output:
            process = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                with suppress(subprocess.TimeoutExpired):  # it has left no result
                    process.wait(self._limit_s + _GRACE_S)
            finally:
                _kill(process)
            output.seek(0)
            return output.read().decode("utf-8", "replace")

    def _interpreter(self, head: Mapping[str, Any]) -> str:
        """Return the Python that the controller ran with, which has what it imports."""
        used = str(head.get("executable") or "")
        is_usable = not self._taped.is_imported and Path(used).name.lower().startswith("py")
        return used if is_usable and os.access(used, os.X_OK) else sys.executable


def _kill(process: subprocess.Popen[bytes]) -> None:
    """End a replay and the processes that it has started."""
    if os.name == "posix":
        with suppress(ProcessLookupError, PermissionError):  # all have ended
            os.killpg(process.pid, signal.SIGKILL)
    elif process.poll() is None:
        process.kill()
    process.wait()


def _environment(head: Mapping[str, Any], data_dir: Path) -> dict[str, str]:
    environment = {name: text for name, text in os.environ.items() if name[:7] != "WEBOTS_"}
    path = [str(_PACKAGE_PARENT), environment.get("PYTHONPATH", "")]
    environment |= {
        "PYTHONPATH": os.pathsep.join(filter(None, path)),
        "PYTHONDONTWRITEBYTECODE": "1",
        DATA_DIR_VARIABLE: str(data_dir),
        TAPE_VARIABLE: "0",
        "WEBOTS_MCP_KEEP_LAST_S": "0",
        "WEBOTS_MCP_HANG_AFTER_S": "0",
        "WEBOTS_MCP_THROTTLE_INTERVAL": str(head.get("throttle_interval", 1000)),
        "WEBOTS_MCP_INSPECT": "0",
    }
    if head.get("parameters"):
        environment[PARAMETERS_VARIABLE] = str(head["parameters"])
    seed = str(head.get("hash_seed") or "random")
    environment["PYTHONHASHSEED"] = "0" if seed == "random" else seed  # the same for both versions
    return environment


# -- the question ----------------------------------------------------------------------------------


def rerun(
    taped: TapedRun,
    file: Path,
    *,
    until_s: float | None = None,
    limit_s: float = LIMIT_S,
    stall_s: float = STALL_S,
) -> Rerun:
    """Run a version of a controller on the tape of a run, after the version that recorded it.

    Args:
        taped: The run.
        file: The new version.
        until_s: Simulation time in the run at which the replay ends.
        limit_s: Wall time for each of up to four replays.
        stall_s: Wall time without a step after which a replay is ended.

    Raises:
        WebotsMCPError: There is no tape, or it does not hold the old version.
    """
    if taped.basis is not None:
        with Replays(taped, until_s, limit_s, stall_s) as replays:
            noted = replays.run(replays.old_file, replays.old_root, notes_commands=True)
            if (failed := _not_repeated(taped, replays, noted, file)) is not None:
                return failed
        taped = taped._replace(tape=with_commands(taped.tape, noted.given))
    with Replays(taped, until_s, limit_s, stall_s) as replays:
        old = replays.run(replays.old_file, replays.old_root)
        if (failed := _not_repeated(taped, replays, old, file)) is not None:
            return failed
        root = root_of(file)
        new_sources = _sources_now(file, root, replays.old_sources)
        new = replays.run(file, root)
        answer = _answer(taped, file, new, of_rounds=old.rounds)
        named = relative_source(file, root) or file.name
        renamed = {named: str(taped.tape.head["controller"])}
        now = new_sources | {renamed[named]: new_sources[named]}
        answer.is_unchanged = all(now.get(n) == text for n, text in replays.old_sources.items())
        if answer.outcome == "differs":
            places = tuple(new.differences[0][1:]) if new.differences else (None, None)
            again = _trace_both(replays, file, root, new.rounds)
            known = {(each[0], each[1]) for each in old.witnesses}
            added = [each for each in new.witnesses if (each[0], each[1]) not in known]
            answer.likely_causes = [str(Witness(*each)) for each in added]
            if again[0].differences or again[1].differences != new.differences:
                return _by_chance(answer, again, (old, new))
            traces = [[TracedLine(*each) for each in result.lines] for result in again]
            sources = replays.old_sources, new_sources
            line = find_deciding_line(
                traces[0], traces[1], *sources, (places[0], places[1]), renamed
            )
            answer.deciding_line = line._asdict() if line else None
        return answer


def _sources_now(file: Path, root: Path, old: Mapping[str, str]) -> dict[str, str]:
    """Return the files of the new version: those next to it, and those the old one imported."""
    texts = read_sources([file, *files_near(file, root)], root, set())
    for name in old.keys() - texts.keys():
        if (root / name).is_file():
            texts[name] = (root / name).read_text("utf-8", "surrogateescape")
    return texts


def _answer(taped: TapedRun, file: Path, result: ReplayResult, of_rounds: int) -> Rerun:
    """Return what a replay shows."""
    outcome = "equal"
    if result.timed_out:
        outcome = "timed out"
    elif result.differences:
        outcome = "differs"
    elif result.unrecorded:
        outcome = "not on the tape"
    elif result.why_ended in (None, "ended early") and result.rounds < of_rounds:
        outcome = "ended early"
    return Rerun(
        outcome,
        taped.run_id,
        str(file),
        max(result.rounds, 0),
        result.time_s,
        of_rounds,
        [each[0] for each in result.differences],
        unrecorded=result.unrecorded,
        exception=result.exception,
        place=result.place,
        began_late=bool(taped.tape.head.get("began_late")),
        ends_with_tape=result.why_ended == "the tape ended",
        goes_on=result.why_ended == "the old code ended",
        in_earlier_run=result.run < taped.number,
        rounds_per_s=result.rounds / max(result.processor_s, 1e-6),
        basis=taped.basis,
    )


def _not_repeated(taped: TapedRun, replays: Replays, old: ReplayResult, file: Path) -> Rerun | None:
    """Return why the old version does not repeat itself; None if it does."""
    answer = _answer(taped, file, old, old.rounds)
    ended_early = old.why_ended in (None, "ended early") and not old.timed_out
    if answer.outcome == "equal" and not ended_early:
        return None
    if answer.outcome == "timed out":
        answer.place = f"the recorded code, at {old.place}; give a time with until"
        return answer
    if "not recorded" in (old.unrecorded or "") or (taped.basis and old.unrecorded):
        return answer  # a picture, or what no row has: that is no chance
    differing = answer.first_differences if taped.basis else []
    answer.outcome, answer.first_differences, answer.place = "not repeatable", [], None
    found = [Witness(*each) for each in old.witnesses]
    texts = [f"it raised {old.exception} at {old.place}, now"] if old.exception else []
    texts += [str(each) for each in found if each.round <= old.rounds]
    if old.threads:
        texts.append(f"{likely_cause.THREADS} ({old.threads[0]} called Webots)")
    texts += [str(each) for each in dated_lines(replays.old_sources)]
    texts += [f"it sets {each}, which the rows have" for each in differing if not texts]
    if answer.began_late:
        texts.append(f"the tape began after the robot was made. {HOW_TO_RECORD}")
    if not texts and _depends_on_hashes(replays):
        texts = [likely_cause.ORDER]
    texts = texts or [str(each) for each in outside_lines(replays.old_sources)]
    answer.likely_causes = texts
    return answer


def _by_chance(
    answer: Rerun,
    again: tuple[ReplayResult, ReplayResult],
    before: tuple[ReplayResult, ReplayResult],
) -> Rerun:
    """Return the answer where a second replay of a version shows something else than the first."""
    answer.outcome, answer.first_differences = "not repeatable", []
    answer.of_new_code = not again[0].differences
    found = before[answer.of_new_code].witnesses
    answer.likely_causes = [str(Witness(*each)) for each in found]
    return answer


def _depends_on_hashes(replays: Replays) -> bool:
    """Return whether replays with one seed of Python's hashes agree, and with another differ."""
    results: list[tuple[int, Any]] = []
    for seed in ("1", "1", "2", "3"):
        result = replays.with_hash_seed(seed)
        results.append((result.rounds, result.differences))
    return results[0] == results[1] and any(each != results[0] for each in results[2:])


def _trace_both(
    replays: Replays, file: Path, root: Path, number: int
) -> tuple[ReplayResult, ReplayResult]:
    """Trace the old and the new version in a round, in which they differ."""
    versions = ((replays.old_file, replays.old_root), (file, root))
    old, new = (replays.run(*version, traced_round=number) for version in versions)
    return old, new


def debug(
    taped: TapedRun,
    file: Path,
    *,
    until_s: float | None = None,
    break_at_s: float | None = None,
    break_round: int | None = None,
) -> ReplayResult:
    """Run a version in Python's debugger on this terminal, which begins at a moment of the old run.

    Args:
        taped: The run.
        file: The version.
        until_s: Simulation time at which the replay ends.
        break_at_s: Simulation time at which the debugger begins.
        break_round: The round at which it begins, where no time is given.
    """
    with Replays(taped, until_s, LIMIT_S, STALL_S) as replays:
        asked = {"break_at_s": break_at_s} if break_at_s is not None else {}
        if break_at_s is None:
            asked = {"break_round": max(break_round or 0, 1)}
        return replays.run(file, root_of(file), shows=True, **asked)
