"""A controller that is interrupted (Ctrl-C) at one chosen place of the bridge's code."""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import webots_mcp
from tests.benchmarks.ways import Rover
from webots_mcp import MCPBridge
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.database.waiting_file import adopt

PACKAGE = str(Path(webots_mcp.__file__).parent)
# What writes; an interrupt anywhere else finds nothing half done.
WRITING = {
    f"{name}.py"
    for name in (
        *("recorder", "backlog", "journal", "session", "simulation", "mcp_bridge"),
        *("waiting_file", "transactions", "connection", "watchdog"),
    )
}
Place = tuple[str, int, int]  # file, line, and the instruction in it or -1


class Outcome(NamedTuple):
    """What became of a controller's rows.

    Attributes:
        interrupted: Whether the place was reached.
        missing: Rows whose `publish` had returned and that are not there.
        doubled: Rows that are there twice.
        miscounted: Runs whose `rows` is wrong.
        blocked: Another writer could not write right after the interrupt.
        held: The recorder was still held at the end, or a transaction was open.
    """

    interrupted: bool
    missing: int
    doubled: int
    miscounted: int
    blocked: bool
    held: bool

    @property
    def is_clean(self) -> bool:
        """Whether the interrupt cost nothing."""
        return not any(self[1:])


class Interrupter:
    """Traces the bridge's code; at a chosen place it raises KeyboardInterrupt, once.

    Args:
        instructions: Places are single instructions, not lines.
        at: Where to interrupt, and at which visit; None only looks.
        template: A database without a row, to begin with.
    """

    def __init__(
        self,
        *,
        instructions: bool,
        at: tuple[Place, int] | None = None,
        template: Path | None = None,
    ) -> None:
        self._instructions = instructions
        self._at = at
        self.template = template
        self.visits = Counter[Place]()
        self.done = False

    def run(self, act: Callable[[], object]) -> bool:
        """Run `act` under the trace; False where it was interrupted."""
        if not self.done:
            sys.settrace(self._trace)
        try:
            next(_apart(act))
        except KeyboardInterrupt:
            return False
        finally:
            sys.settrace(None)
        return True

    def _trace(self, frame: FrameType, event: str, _: Any) -> Any:
        file = frame.f_code.co_filename
        if not file.startswith(PACKAGE) or Path(file).name not in WRITING:
            return None
        frame.f_trace_opcodes = self._instructions
        if event == ("opcode" if self._instructions else "line"):
            self._visit((file, frame.f_lineno or 0, frame.f_lasti if self._instructions else -1))
        return self._trace

    def _visit(self, place: Place) -> None:
        self.visits[place] += 1
        if not self.done and self._at == (place, self.visits[place]):
            self.done = True
            raise KeyboardInterrupt


def _apart(act: Callable[[], object]) -> Iterator[object]:
    """Act with a generator's own state of handled exceptions.

    Python 3.11 goes on "handling" an exception where a trace function raises at the end of an
    `except`; the interrupted code's exception would be the context of all later ones.
    """
    yield act()


def make_template(folder: Path) -> Path:
    """A database without a row."""
    file = folder / "template.db"
    with closing(connect(file, "writer", create=True)) as connection:
        create_schema(connection)
    return file


def places(folder: Path, *, instructions: bool) -> list[tuple[Place, int]]:
    """Where a controller can be interrupted: each place at its first and its last visit."""
    looking = Interrupter(instructions=instructions)
    drive(folder, looking)
    return [
        (place, visit)
        for place, count in sorted(looking.visits.items())
        for visit in ({1, count} if instructions else {1})
    ]


def drive(folder: Path, interrupter: Interrupter) -> Outcome:
    """A controller with another writer beside it, which goes on after the interrupt."""
    file = folder / DATABASE_NAME
    folder.mkdir()
    if interrupter.template is not None:
        shutil.copy(interrupter.template, file)  # far quicker than to make one
    robot = Rover()
    bridge = MCPBridge(robot, folder, 1)
    returned: list[int] = []
    blocked = False
    with closing(connect(file, "writer")) as other:

        def publish(n: int) -> None:
            robot.step(16)
            if interrupter.run(lambda: bridge.publish({"n": n, "mode": n % 2 == 0})):
                returned.append(n)

        for n in range(12):
            before = interrupter.done
            if n == 3:
                other.execute("BEGIN IMMEDIATE")
            if n == 6:
                other.execute("ROLLBACK")
            if n == 9:
                robot.reset()
            publish(n)
            interrupter.run(bridge.get_command)
            if n in (5, 7):
                interrupter.run(lambda: bridge._session.heartbeat.beat())  # pyright: ignore[reportPrivateUsage]
            if interrupter.done and not before and not other.in_transaction:
                blocked = not _can_write(other)
    interrupter.run(bridge.close)
    held = _is_held(bridge)
    bridge.close()
    return Outcome(interrupter.done, *_count(file, returned), blocked, held)


def _can_write(other: sqlite3.Connection) -> bool:
    other.execute("PRAGMA busy_timeout=200")
    try:
        other.execute("BEGIN IMMEDIATE")
    except sqlite3.OperationalError:
        return False
    other.execute("ROLLBACK")
    return True


def _is_held(bridge: MCPBridge) -> bool:
    """Whether the recorder stays taken, or a transaction open, after one more call."""
    recorder = bridge._session.recorder  # pyright: ignore[reportPrivateUsage]
    recorder.flush()
    held = bool(recorder._lock._held)  # pyright: ignore[reportPrivateUsage]
    connection = recorder.connection
    return held or (connection is not None and connection.in_transaction)


def _count(file: Path, returned: list[int]) -> tuple[int, int, int]:
    with closing(connect(file, "writer")) as connection:
        adopt(connection, file)
        texts = connection.execute("SELECT data FROM state").fetchall()
        miscounted = connection.execute(
            "SELECT count(*) FROM run WHERE ended_wall_time_s IS NOT NULL AND "
            "row_count <> (SELECT count(*) FROM state WHERE run_id = run.id)"
        ).fetchone()[0]
    numbers = Counter(json.loads(text)["n"] for (text,) in texts)
    missing = sum(n not in numbers for n in returned)
    return missing, sum(count > 1 for count in numbers.values()), miscounted
