"""What has to run in a process of its own: `python -m tests.benchmarks.programs NAME ARGUMENT...`.

One that is spoken to says "ready" and answers each line with one line of JSON. What `memory` and
`one_tool_server` import counts, so that each function imports what it needs.
"""

from __future__ import annotations

import json
import os
import sqlite3
import sys
import time

_STEP_MS = 32


def say(value: object) -> None:
    """Answer who started this program."""
    print(json.dumps(value), flush=True)


def answering_robot(folder: str) -> None:
    """A robot that answers commands in an 8 ms loop until its standard input ends."""
    import threading

    from tests.benchmarks.ways import Rover, make_states
    from webots_mcp import MCPBridge

    robot, states, over = Rover(), make_states(), threading.Event()
    with MCPBridge(robot, data_dir=folder, throttle_interval=1, keep_last_s=0) as bridge:
        bridge.register_command("echo", lambda command: command["params"])
        threading.Thread(target=lambda: (sys.stdin.read(), over.set()), daemon=True).start()
        bridge.publish(states[0])
        say("ready")
        step = 0
        while not over.is_set():
            robot.pace()
            bridge.publish(states[step % len(states)])
            bridge.get_command()
            step += 1


def claimer(database: str) -> None:
    """Claims the commands of robot 1 until none is left, and says which it got."""
    from pathlib import Path

    from webots_mcp.database.connection import connect
    from webots_mcp.database.queue import CLAIM, PEEK
    from webots_mcp.database.transactions import never_wait

    connection = connect(Path(database), "loop")
    never_wait(connection)
    say("ready")
    sys.stdin.readline()
    claimed: list[int] = []
    while connection.execute(PEEK, (1, time.time())).fetchone():
        values = {"session": None, "now": time.time(), "sim_time": 0.0, "robot": 1}
        try:
            claimed += [row[0] for row in connection.execute(CLAIM, values).fetchall()]
        except sqlite3.OperationalError as error:  # another claimer holds the lock at this instant
            if "locked" not in str(error):
                raise
    say(claimed)


def crowd_robot(folder: str, number: str) -> None:
    """One of several robots at once: `NAME STEPS` drives a block of 8 ms steps.

    The answer has the durations of publish() in seconds, and the share of calls with rows waiting.
    `noise` is `json.dumps` alone: what the machine's business does to the figures.
    """
    from pathlib import Path

    from tests.benchmarks.ways import BridgeWay, Rover, make_states

    robot, states = Rover(f"rover {number}"), make_states()
    bridge = BridgeWay(robot, Path(folder))
    ways = {
        "bridge": (bridge.publish, bridge.get_command),
        "noise": (json.dumps, lambda: None),
    }
    say("ready")
    for line in sys.stdin:
        name, steps = line.split()
        publish, get_command = ways[name]
        put_off, durations = 0, list[float]()
        for i in range(int(steps)):
            robot.pace()
            started = time.perf_counter()
            publish(states[i % len(states)])
            durations.append(time.perf_counter() - started)
            get_command()
            put_off += bridge.bridge.stats().rows_waiting > 0
        say({"durations": durations, "put_off": put_off / int(steps)})
    bridge.close()


def victim(folder: str, name: str, pause_s: str) -> None:
    """A controller that is going to be killed: it records, and says what it recorded.

    After each publish() it writes the row's number and how many rows wait to be written. The
    command `tally` leaves its id in the file `tally`.
    """
    from pathlib import Path

    from tests.benchmarks.ways import Rover, make_states
    from webots_mcp import MCPBridge

    state, robot, number = make_states(1)[0], Rover(name), 0
    bridge = MCPBridge(robot, folder, throttle_interval=1)
    tally = os.open(Path(folder, "tally"), os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    bridge.register_command("tally", lambda command: os.write(tally, b"%d\n" % command["id"]))
    while True:
        robot.step(8)
        bridge.get_command()
        bridge.publish({**state, "n": number})
        os.write(1, f"{number} {bridge.stats().rows_waiting}\n".encode())
        time.sleep(float(pause_s))
        number += 1


def one_tool_server() -> None:
    """The smallest MCP server of the same library: what ours is compared with."""
    from mcp.server import MCPServer

    server = MCPServer("one tool")

    @server.tool()
    def add(a: int, b: int) -> int:  # pyright: ignore[reportUnusedFunction]
        """Add two numbers."""
        return a + b

    server.run()


def memory(kind: str, states: str, *order: str) -> None:
    """Print how much memory this process holds: `bare`, or with a `bridge` (and perhaps `orjson`).

    STATES is a JSON file of states to publish; ORDER is FOLDER ROWS ROWS_PER_S.
    """
    with open(states) as file:  # noqa: PTH123
        loaded = json.load(file)
    if kind != "orjson":  # as if it were not installed
        sys.modules["orjson"] = None  # pyright: ignore[reportArgumentType]
    say(_held() if kind == "bare" else _held_while_recording(loaded, *order))


def _held_while_recording(
    states: list[dict[str, object]], folder: str, rows: str, rows_per_s: str
) -> dict[str, float]:
    """Publish so many rows; after a tenth of them everything is warm."""
    from tests.benchmarks.ways import Rover
    from webots_mcp import MCPBridge

    robot = Rover()
    bridge = MCPBridge(robot, folder, throttle_interval=1)
    warm, log_bytes, started_s = {}, 0, time.perf_counter()
    for i in range(int(rows)):
        robot.step(_STEP_MS)
        bridge.publish(states[i % len(states)])
        if i % 50 == 0:
            log = f"{bridge.database}-wal"
            log_bytes = max(log_bytes, os.stat(log).st_size if os.path.exists(log) else 0)  # noqa: PTH116, PTH110
            time.sleep(max(0.0, started_s + i / int(rows_per_s) - time.perf_counter()))
        if i == int(rows) // 10:
            warm = _held()
    figures = _held()
    bridge.close()
    return {**figures, "grown": figures["private"] - warm["private"], "log": log_bytes}


def _held() -> dict[str, float]:
    """Resident and private (unique) bytes of this process; 0 where the system does not tell."""
    try:
        with open("/proc/self/smaps_rollup") as file:  # noqa: PTH123
            lines = [line.split() for line in file if line.endswith("kB\n")]
    except OSError:
        return {"resident": 0, "private": 0}
    sizes = {words[0]: int(words[1]) * 1024 for words in lines}
    private = sizes["Private_Clean:"] + sizes["Private_Dirty:"]
    return {"resident": sizes["Rss:"], "private": private}


PROGRAMS = (answering_robot, claimer, crowd_robot, victim, one_tool_server, memory)

if __name__ == "__main__":
    _named = {program.__name__: program for program in PROGRAMS}
    _named[sys.argv[1]](*sys.argv[2:])
