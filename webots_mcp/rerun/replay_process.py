"""The process that runs one version of a controller on a tape: `python -m ...replay_process JOB`.

The job is a JSON file, and so is the result. The bridges of the controller record into a new
database, which is thrown away.
"""

from __future__ import annotations

import faulthandler
import json
import mmap
import os
import pdb
import re
import runpy
import struct
import sys
import threading
import time
import traceback
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Final, TextIO

from webots_mcp.database import location
from webots_mcp.database.tapes import tape_notes
from webots_mcp.database.tapes.package_surface import caller_frame
from webots_mcp.database.tapes.source_files import relative_source
from webots_mcp.database.tapes.tape import open_tape
from webots_mcp.database.tapes.tape_values import UnrecordedValueError
from webots_mcp.rerun.deciding_line import RoundTracer
from webots_mcp.rerun.likely_cause import Witnesses
from webots_mcp.rerun.replayed_tape import ReplayedTape, ReplayEndedError, activate

_frames_of_threads: Final = sys._current_frames  # pyright: ignore[reportPrivateUsage]
PACKAGES_FOLDER: Final = Path(__file__).parent / "lib"
_NOT_DEBUGGED: Final = ("webots_mcp*", "controller*", "vehicle*", "bdb", "pdb")  # modules
TIMED_OUT: Final = 3  # exit code
PROGRESS: Final = struct.Struct("<qdq")  # rounds, simulation time, run
PROGRESS_FILE: Final = "progress"  # next to the result, for a replay that cannot write one
STACK_FILE: Final = "stack.txt"  # of one that was ended while C code held the interpreter
_GRACE_S: Final = 5.0
_EDITORS_DEBUGGER: Final = "pydevd"  # of debugpy, which VS Code runs; a person may look for long


@dataclass
class ReplayJob:
    """One version to run on a tape.

    Attributes:
        tape: The file of the tape.
        file: The controller to run.
        root: The folder of the project that it belongs to.
        folder: The folder to run it in.
        data_dir: A new folder for its recording.
        result: The file to write the result to.
        run: The run of the session, from 0, to whose end it is replayed.
        until_s: Simulation time in that run at which it ends.
        stall_s: Wall time without a step after which it is ended by force.
        limit_s: Wall time after which it is ended in any case.
        traced_round: The round whose lines are traced.
        break_round: The round at which a debugger begins.
        break_at_s: Simulation time at which a debugger begins.
        notes_commands: Whether the result has all commands.
    """

    tape: str
    file: str
    root: str
    folder: str
    data_dir: str
    result: str
    run: int = 0
    until_s: float | None = None
    stall_s: float = 60.0
    limit_s: float = 3600.0
    traced_round: int | None = None
    break_round: int | None = None
    break_at_s: float | None = None
    notes_commands: bool = False

    @property
    def debugs(self) -> bool:
        """Whether a person debugs it."""
        return self.break_round is not None or self.break_at_s is not None


@dataclass
class ReplayResult:
    """What came of a replay.

    Attributes:
        rounds: Rounds whose commands were compared.
        time_s: Simulation time that it came to, in the run `run`.
        run: The run of the session that it came to, from 0.
        differences: The first difference: texts, and the places of its commands, old and new.
        unrecorded: The question that the tape does not answer; it ended the replay.
        why_ended: Why no further step was replayed; None where the controller ended before.
        exception: The exception that ended the controller.
        place: Where that was raised, or where an unrecorded question was asked.
        witnesses: What differs from run to run, and where it was used: cause, call, place, round.
        threads: Names of other threads that called Webots' package in the old run.
        lines: The traced lines: file, line, values.
        processor_s: Processor time of the controller and the replay.
        timed_out: It was ended by force; `place` is where it was.
        given: All commands, where they were to be noted: round, path, class, name, arguments and
            place.
    """

    rounds: int = 0
    time_s: float = 0.0
    run: int = 0
    differences: list[Any] = field(default_factory=list[Any])
    unrecorded: str | None = None
    why_ended: str | None = None
    exception: str | None = None
    place: str | None = None
    witnesses: list[Any] = field(default_factory=list[Any])
    threads: list[str] = field(default_factory=list[str])
    lines: list[Any] = field(default_factory=list[Any])
    processor_s: float = 0.0
    timed_out: bool = False
    given: list[Any] = field(default_factory=list[Any])


class _Replay:
    def __init__(self, job: ReplayJob) -> None:
        self._job = job
        self._root = Path(job.root)
        tape = open_tape(Path(job.tape))
        options: Any = {"run": job.run, "until_s": job.until_s, "root": job.root}
        self.tape = ReplayedTape(tape, goes_on=job.debugs, **options)
        self._witnesses = Witnesses(self._root, lambda: self.tape.rounds)
        self._tracer = RoundTracer(self._root, -1 if job.traced_round is None else job.traced_round)
        self._began_s = time.process_time()
        self._is_debugging = False
        self._progress = bytearray(PROGRESS.size)
        self.tape.on_round = self._begin_round
        self.tape.given = [] if job.notes_commands else None

    def run(self) -> None:
        """Run the controller to its end, and write the result."""
        result = ReplayResult()
        self._prepare()
        try:
            self._begin_round(0)
            runpy.run_path(self._job.file, run_name="__main__")
        except ReplayEndedError as error:
            result.place = self._place_of(error.__traceback__)
        except SystemExit as error:
            if error.code not in (None, 0):
                result.exception = f"SystemExit: {error.code}"
        except UnrecordedValueError as error:
            self.tape.unrecorded = f"{error} was not recorded"
            result.place = self._place_of(error.__traceback__)
        except BaseException as error:  # noqa: BLE001  (whatever ends a controller is the result)
            result.place = self._place_of(error.__traceback__)
            # The last line: a wrong syntax is shown with its code, which has lines of its own.
            result.exception = "".join(traceback.format_exception_only(error)).strip()
            result.exception = result.exception.splitlines()[-1]
            if isinstance(error, SyntaxError) and error.filename:
                file = relative_source(error.filename, self._root) or error.filename
                result.place = f"{file}:{error.lineno}"
                result.exception = f"{type(error).__name__}: {error.msg}"
        finally:
            sys.settrace(None)
        if self.tape.why_ended is None and self.tape.unrecorded is None:
            self.tape.step_never_comes()
        self.tape.finish()
        self.write(result)

    def _prepare(self) -> None:
        """Let the controller find Webots' package, its arguments, and a recording of its own."""
        job, head = self._job, self.tape.tape.head
        activate(self.tape)
        tape_notes.replayed = self.tape
        data_dir = Path(job.data_dir)
        here = (data_dir / "webots.db", data_dir)

        def resolve(*_: object, **__: object) -> tuple[Path, Path]:
            return here  # whatever a controller names

        location.resolve_database = resolve
        sys.path[:] = [str(Path(job.file).parent), str(PACKAGES_FOLDER), *sys.path[1:]]
        sys.argv = [job.file, *head["arguments"]]
        os.chdir(job.folder)
        self._witnesses.begin()
        if not job.debugs and _EDITORS_DEBUGGER not in sys.modules:
            folder = Path(job.result).parent
            self._progress = _shared_memory(folder / PROGRESS_FILE)
            stack = (folder / STACK_FILE).open("w")
            threading.Thread(target=self._end_in_time, args=(stack,), daemon=True).start()

    def _begin_round(self, number: int) -> None:
        job, tape = self._job, self.tape
        PROGRESS.pack_into(self._progress, 0, tape.rounds, tape.time_s, tape.run)
        if job.traced_round is not None:
            self._tracer.begin_round(number)
            if number > job.traced_round:
                raise ReplayEndedError
        is_due = number == job.break_round or (
            job.break_at_s is not None
            and self.tape.run == job.run
            and self.tape.time_s >= job.break_at_s - 1e-9
        )
        if is_due and job.debugs and not self._is_debugging and number > 0:
            self._is_debugging = True
            self._debug()

    def _debug(self) -> None:
        frame: FrameType | None = caller_frame(1)
        while frame is not None and not self._is_users(frame):
            frame = frame.f_back
        shown = f"round {self.tape.rounds} of the old run, {self.tape.time_s:.3f} s"
        sys.stderr.write(f"webots-mcp: {shown}; 'c' goes on, 'q' ends it\n")
        if frame is not None:
            debugger = pdb.Pdb(nosigint=True, skip=_NOT_DEBUGGED)
            debugger.set_trace(frame)
            debugger.set_next(frame)  # not in the bridge, which runs before the step returns

    def _is_users(self, frame: FrameType) -> bool:
        return relative_source(frame.f_code.co_filename, self._root) is not None

    def _place_of(self, found: Any) -> str | None:
        place = None
        while found is not None:
            if self._is_users(found.tb_frame):
                file = relative_source(found.tb_frame.f_code.co_filename, self._root)
                place = f"{file}:{found.tb_lineno}"
            found = found.tb_next
        return place

    def _end_in_time(self, stack: TextIO) -> None:
        """End the process when its time is over: a controller may loop without a step.

        Where C code holds the interpreter, this thread does not run either: then `faulthandler`,
        which needs no interpreter, writes the stack and ends the process.
        """
        pause, rounds = threading.Event(), -1
        ends_s = time.monotonic() + self._job.limit_s
        while self.tape.rounds > rounds and time.monotonic() < ends_s:
            rounds = self.tape.rounds
            in_s = 2 * self._job.stall_s + _GRACE_S
            faulthandler.dump_traceback_later(in_s, exit=True, file=stack)
            pause.wait(min(self._job.stall_s, max(ends_s - time.monotonic(), 0.0)))
        result = ReplayResult(timed_out=True)
        main = _frames_of_threads().get(threading.main_thread().ident or 0)
        while main is not None and not self._is_users(main):
            main = main.f_back
        if main is not None:
            file = relative_source(main.f_code.co_filename, self._root)
            result.place = f"{file}:{main.f_lineno}"
        faulthandler.cancel_dump_traceback_later()
        self.write(result)
        os._exit(TIMED_OUT)

    def write(self, result: ReplayResult) -> None:
        """Write the result as a whole."""
        tape = self.tape
        result.rounds, result.time_s, result.run = tape.rounds, tape.time_s, tape.run
        result.differences = [
            (
                str(each),
                each.old_place and str(each.old_place),
                each.new_place and str(each.new_place),
            )
            for each in tape.first
        ]
        result.unrecorded, result.why_ended = tape.unrecorded, tape.why_ended
        result.witnesses = [tuple(each) for each in self._witnesses.found.values()]
        result.threads, result.lines = tape.threads, [tuple(each) for each in self._tracer.lines]
        result.given = tape.given or []
        result.processor_s = time.process_time() - self._began_s
        file = Path(self._job.result)
        aside = file.with_suffix(".part")
        aside.write_text(json.dumps(asdict(result)), "utf-8")
        aside.replace(file)


def _shared_memory(file: Path) -> Any:
    """Return memory that is also a file, so that it outlives the process."""
    file.write_bytes(bytes(PROGRESS.size))
    with file.open("r+b") as opened:
        return mmap.mmap(opened.fileno(), PROGRESS.size)


def result_of_stack(folder: Path, root: Path) -> ReplayResult | None:
    """Return the result of a replay that `faulthandler` ended; None of any other.

    Args:
        folder: That of its result.
        root: The folder of the project.
    """
    try:
        stack = (folder / STACK_FILE).read_text("utf-8", "replace")
        rounds, time_s, run = PROGRESS.unpack((folder / PROGRESS_FILE).read_bytes())
    except (OSError, struct.error):
        return None
    if not stack:
        return None
    main = stack.rpartition("Thread 0x")[2]  # comes last, its innermost call first
    places = re.findall(r'File "(.+)", line (\d+) in', main)
    own = ((relative_source(file, root), line) for file, line in places)
    place = next((f"{file}:{line}" for file, line in own if file is not None), None)
    return ReplayResult(rounds=rounds, time_s=time_s, run=run, place=place, timed_out=True)


def main(arguments: list[str]) -> int:
    """Run the job in the file that is named."""
    job = ReplayJob(**json.loads(Path(arguments[0]).read_text("utf-8")))
    _Replay(job).run()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # what a controller leaves behind must not delay the answer


if __name__ == "__main__":
    main(sys.argv[1:])
