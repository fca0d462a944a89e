"""What kills and interrupts (Ctrl-C) cost a controller: rows, files, commands."""

from __future__ import annotations

import random
import sqlite3
import subprocess
import time
from collections import Counter
from collections.abc import Generator, Iterable
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.core import Bench, Line, Target, benchmark
from tests.benchmarks.processes import environment, program_line
from tests.benchmarks.servers import our_server
from tests.bridge.interrupting import Interrupter, Outcome, drive, make_template, places
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect
from webots_mcp.database.queue import CommandQueue
from webots_mcp.database.waiting_file import adopt, waiting_paths

_LONGEST_LIFE_S = 0.3
_COMMANDS = 5  # for each life
_ROWS_OF = (
    "SELECT json_extract(data, '$.n') FROM state JOIN run ON run.id = run_id "
    "WHERE session_id = (SELECT max(id) FROM session WHERE pid = ?) ORDER BY state.id"
)


@dataclass
class _Toll:
    """What the kills of some controllers cost."""

    robots: int
    pause_s: float
    served: bool = False
    kills: int = 0
    published: int = 0
    waited: int = 0
    lost: int = 0
    damaged: int = 0
    ran: int = 0
    twice: int = 0

    def line(self) -> Line:
        """Rows lost of those published, and how many had not been in the database yet."""
        server = " and a server" if self.served else ""
        loop = f"{1000 * self.pause_s:g} ms loops" if self.pause_s else "no pause"
        return Line(
            f"rows lost, {self.robots} robots{server}, {loop}",
            f"{self.kills} kills",
            f"{self.published:,} published, {self.waited:,} recovered after the kill",
            self.lost,
            "rows",
            Target(0),
        )


@benchmark("kills", "controllers killed (SIGKILL) while they record")
def measure_kills(bench: Bench) -> Iterable[Line]:
    tolls = [_Toll(1, 0.008), _Toll(3, 0.0005, True), _Toll(3, 0.008, True), _Toll(4, 0.0)]
    for number, toll in enumerate(tolls):
        kills = bench.kills if bench.kills and toll.served else bench.count(60)
        place = bench.place(f"{number}")
        with _serving(place / DATABASE_NAME, toll.served):
            for life in range(-(-kills // toll.robots)):
                bench.say(f"{toll.robots} robots, {toll.kills} of {kills} kills")
                _kill_bridges(place, toll, random.Random(life))
        _inspect(place, toll)
        yield toll.line()
    damaged, twice = sum(toll.damaged for toll in tolls), sum(toll.twice for toll in tolls)
    kills = f"{sum(toll.kills for toll in tolls)} kills"
    yield Line("databases damaged, or out of order", kills, "", damaged, "files", Target(0))
    ran = f"{sum(toll.ran for toll in tolls)} ran"
    yield Line("commands run twice", ran, f"{_COMMANDS} for each life", twice, "twice", Target(0))


@contextmanager
def _serving(database: Path, served: bool) -> Generator[None]:
    """A server over the database, which maintains it, for as long as that lasts."""
    if not served:
        yield
        return
    server = our_server(database)
    line, pipe = [server.command, *server.args], subprocess.PIPE
    with subprocess.Popen(line, stdin=pipe, stdout=pipe, env=server.env) as process:
        yield
        process.kill()


def _kill_bridges(folder: Path, toll: _Toll, lives: random.Random) -> None:
    """One life of each robot: they end at different moments, the others record meanwhile."""
    victims = [_start(folder, f"rover {n}", toll) for n in range(toll.robots)]
    first = [_first_line(victim) for victim in victims]
    _send_commands(folder / DATABASE_NAME, toll.robots)
    for victim in lives.sample(victims, len(victims)):
        time.sleep(lives.uniform(0, _LONGEST_LIFE_S))
        victim.kill()
    told = [start + _rest(victim) for start, victim in zip(first, victims, strict=True)]
    with closing(connect(folder / DATABASE_NAME, "writer")) as connection:
        _open_next(connection, folder / DATABASE_NAME)
        for victim, lines in zip(victims, told, strict=True):
            _count_rows(connection, victim.pid, lines, toll)


def _open_next(connection: sqlite3.Connection, database: Path) -> None:
    """As whoever opens the database next; the server may be at it already."""
    deadline_s = time.monotonic() + 10
    while waiting_paths(database) and time.monotonic() < deadline_s:
        adopt(connection, database)


def _count_rows(connection: sqlite3.Connection, pid: int, lines: list[str], toll: _Toll) -> None:
    number, waiting = map(int, lines[-1].split())
    recorded = [row[0] for row in connection.execute(_ROWS_OF, (pid,))]
    if recorded != list(range(len(recorded))):
        toll.damaged += 1  # a gap, or out of order
    toll.kills += 1
    toll.published += number + 1
    toll.waited += waiting
    toll.lost += len(set(range(number + 1)) - set(recorded))


def _inspect(folder: Path, toll: _Toll) -> None:
    with closing(sqlite3.connect(folder / DATABASE_NAME)) as connection:
        if connection.execute("PRAGMA integrity_check").fetchall() != [("ok",)]:
            toll.damaged += 1
    tally = folder / "tally"
    runs = Counter(tally.read_text().split()) if tally.exists() else Counter[str]()
    toll.ran += len(runs)
    toll.twice += sum(count > 1 for count in runs.values())


def _send_commands(database: Path, robots: int) -> None:
    with closing(connect(database, "writer")) as connection:
        queue = CommandQueue(connection)
        for n in range(robots):
            name = (f"rover {n}",)
            found = connection.execute("SELECT id FROM robot WHERE name = ?", name).fetchone()
            for _ in range(_COMMANDS):
                queue.enqueue(found[0], "tally")


def _start(folder: Path, name: str, toll: _Toll) -> subprocess.Popen[str]:
    line = program_line("victim", folder, name, toll.pause_s)
    return subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=environment())


def _first_line(victim: subprocess.Popen[str]) -> list[str]:
    assert victim.stdout is not None
    return [victim.stdout.readline()]


def _rest(victim: subprocess.Popen[str]) -> list[str]:
    """What it had still told; a last line that was cut off is left out."""
    text, _ = victim.communicate()
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]


@benchmark("interrupts", "controllers interrupted (Ctrl-C) inside the bridge")
def measure_interrupts(bench: Bench) -> Iterable[Line]:
    template = make_template(bench.folder)
    found = places(bench.folder / "look", instructions=True)
    wanted = min(bench.count(2000), len(found))
    chosen = random.Random(1).sample(found, wanted)
    outcomes: list[Outcome] = []
    for number, at in enumerate(chosen):
        bench.say(f"{number} of {wanted}")
        interrupter = Interrupter(instructions=True, at=at, template=template)
        outcomes.append(drive(bench.folder / f"{number}", interrupter))
    reached = [outcome for outcome in outcomes if outcome.interrupted]
    for name, what in (
        ("missing", "rows missing"),
        ("doubled", "rows written twice"),
        ("blocked", "other writers locked out"),
        ("held", "recorder held, or in a transaction"),
    ):
        count = sum(int(getattr(outcome, name)) for outcome in reached)
        ours = f"{len(reached):,} interrupts"
        yield Line(what, ours, f"{len(found):,} places", count, "times", Target(0))


BENCHMARKS = (measure_kills, measure_interrupts)
