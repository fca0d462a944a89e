"""What is lost when controllers are killed: rows, files, commands."""

from __future__ import annotations

import json
import random
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Generator, Iterable
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.processes import environment
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.servers import our_server
from tests.benchmarks.table import Line, Target
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.queue import CommandQueue
from webots_mcp.waiting_file import adopt, waiting_paths

_KILLS = 60
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
            f"{self.published:,} published, {self.waited:,} taken in after the kill",
            self.lost,
            "rows",
            Target(0),
        )


@benchmark("kills", "controllers killed (SIGKILL) while they record")
def measure_kills(bench: Bench) -> Iterable[Line]:
    tolls = [_Toll(1, 0.008), _Toll(3, 0.0005, True), _Toll(3, 0.008, True), _Toll(4, 0.0)]
    for number, toll in enumerate(tolls):
        kills = bench.kills if bench.kills and toll.served else bench.count(_KILLS)
        place = bench.place(f"{number}")
        with _serving(place / DATABASE_NAME, toll.served):
            for life in range(-(-kills // toll.robots)):
                bench.say(f"{toll.robots} robots, {toll.kills} of {kills} kills")
                _kill_bridges(place, toll, random.Random(life))
        _inspect(place, toll)
        yield toll.line()
    bench.say("JSON files")
    files = _Toll(1, 0.0)
    _kill_files(bench.place("files"), files, bench.count(_KILLS))
    damaged, twice = sum(toll.damaged for toll in tolls), sum(toll.twice for toll in tolls)
    torn = f"JSON files torn: {files.damaged} of {files.kills}"
    kills = f"{sum(toll.kills for toll in tolls)} kills"
    yield Line("databases damaged, or out of order", kills, torn, damaged, "files", Target(0))
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
    victims = [_start("bridge", folder, f"rover {n}", toll) for n in range(toll.robots)]
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


def _kill_files(folder: Path, toll: _Toll, kills: int) -> None:
    lives = random.Random(0)
    for _ in range(kills):
        victim = _start("files", folder, "rover", toll)
        _first_line(victim)
        time.sleep(lives.uniform(0, _LONGEST_LIFE_S))
        victim.kill()
        _rest(victim)
        toll.kills += 1
        try:
            json.loads((folder / "status.json").read_text())
        except ValueError:
            toll.damaged += 1


def _send_commands(database: Path, robots: int) -> None:
    with closing(connect(database, "writer")) as connection:
        queue = CommandQueue(connection)
        for n in range(robots):
            name = (f"rover {n}",)
            found = connection.execute("SELECT id FROM robot WHERE name = ?", name).fetchone()
            for _ in range(_COMMANDS):
                queue.enqueue(found[0], "tally")


def _start(way: str, folder: Path, name: str, toll: _Toll) -> subprocess.Popen[str]:
    module = "tests.benchmarks.programs.victim"
    line = [sys.executable, "-m", module, way, str(folder), name, str(toll.pause_s)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=environment())


def _first_line(victim: subprocess.Popen[str]) -> list[str]:
    assert victim.stdout is not None
    return [victim.stdout.readline()]


def _rest(victim: subprocess.Popen[str]) -> list[str]:
    """What it had still told; a last line that was cut off is left out."""
    text, _ = victim.communicate()
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
