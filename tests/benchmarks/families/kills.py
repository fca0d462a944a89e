"""What is lost when controllers are killed: rows, files, commands."""

from __future__ import annotations

import json
import random
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.processes import environment
from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.store.queue import CommandQueue

_KILLS = 20
_LONGEST_LIFE_S = 0.3
_COMMANDS = 5  # for each life
_ROWS_OF = (
    "SELECT json_extract(data, '$.n') FROM state JOIN run ON run.id = run_id "
    "JOIN session ON session.id = session_id WHERE pid = ? ORDER BY state.id"
)


@dataclass
class _Toll:
    """What the kills of some controllers cost."""

    at_once: int
    pause_s: float
    kills: int = 0
    published: int = 0
    lost: int = 0
    uncounted: int = 0
    damaged: int = 0
    ran: int = 0
    twice: int = 0

    def line(self, what: str, rows: int, target: Target | None = None) -> Line:
        """So many rows of those published."""
        return Line(
            what, f"{self.kills} kills", f"{self.published:,} published", rows, "rows", target
        )


@benchmark("kills", "controllers killed (SIGKILL) while they record")
def measure_kills(bench: Bench) -> Iterable[Line]:
    alone, crowd, files = _Toll(1, 0.008), _Toll(4, 0.0), _Toll(1, 0.0)
    for name, toll in (("alone", alone), ("crowd", crowd)):
        bench.say(name)
        _kill_bridges(bench.place(name), toll, bench.count(_KILLS // toll.at_once))
    bench.say("JSON files")
    _kill_files(bench.place("files"), files, bench.count(_KILLS))
    yield alone.line("rows lost, one robot, 8 ms loop", alone.lost, Target(0))
    yield crowd.line("rows lost, 4 robots without a pause", crowd.lost)
    yield crowd.line("the same, not counted as waiting", crowd.uncounted, Target(0))
    damaged, twice = alone.damaged + crowd.damaged, alone.twice + crowd.twice
    torn = f"JSON files torn: {files.damaged} of {files.kills}"
    kills = f"{alone.kills + crowd.kills} kills"
    yield Line("databases damaged", kills, torn, damaged, "files", Target(0))
    ran = f"{alone.ran + crowd.ran} ran"
    yield Line("commands run twice", ran, f"{_COMMANDS} for each life", twice, "twice", Target(0))


def _kill_bridges(folder: Path, toll: _Toll, rounds: int) -> None:
    lives = random.Random(toll.at_once)
    for _ in range(rounds):
        victims = [_start("bridge", folder, f"rover {n}", toll) for n in range(toll.at_once)]
        first = [_first_line(victim) for victim in victims]
        _send_commands(folder / DATABASE_NAME, toll.at_once)
        time.sleep(lives.uniform(0, _LONGEST_LIFE_S))
        for victim in victims:
            victim.kill()
        told = [start + _rest(victim) for start, victim in zip(first, victims, strict=True)]
        for victim, lines in zip(victims, told, strict=True):
            _count_rows(folder / DATABASE_NAME, victim.pid, lines, toll)
    _inspect(folder, toll)


def _count_rows(database: Path, pid: int, lines: list[str], toll: _Toll) -> None:
    number, waiting = map(int, lines[-1].split())
    with closing(connect(database, "reader")) as connection:
        recorded = [row[0] for row in connection.execute(_ROWS_OF, (pid,))]
    if recorded != list(range(len(recorded))):
        toll.damaged += 1  # a gap, or out of order
    lost = max(0, number + 1 - len(recorded))
    toll.kills += 1
    toll.published += number + 1
    toll.lost += lost
    toll.uncounted += max(0, lost - waiting)


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
