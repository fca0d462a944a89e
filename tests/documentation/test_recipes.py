"""docs/recipes.md: each recipe is run as it stands, while a robot records."""

from __future__ import annotations

import json
import re
import shutil
import socket
import sqlite3
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.bridge import record

FILE = Path(__file__).parents[2] / "docs" / "recipes.md"
TIMEOUT_S = 60
OFFLINE = "import duckdb_extensions as e; e.import_extension('sqlite_scanner')"
ONLINE = "import duckdb; duckdb.sql('INSTALL sqlite')"

ROBOT = """
import sys
import threading
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

robot = InProcessSupervisor("writer")
bridge = MCPBridge(robot, throttle_interval=1, database=sys.argv[1])
ended = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
print("recording", flush=True)
while not ended.wait(0.008):
    robot.step(16)
    bridge.publish({"pose": [robot.getTime(), 0.0, 0.0], "mode": "cruise", "battery_v": 12.0})
    bridge.get_command()
stats = bridge.stats()
bridge.close()
print(stats.rows_written, stats.rows_dropped, stats.failures, flush=True)
"""


def blocks(section: str, language: str) -> list[str]:
    """The code of a section, block by block."""
    text = FILE.read_text("utf-8")
    body = re.search(rf"(?ms)^## {section}$(.*?)(?=^## |\Z)", text)
    assert body is not None, f"there is no section {section}"
    return re.findall(rf"(?ms)^```{language}\n(.*?)^```$", body[1])


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder whose mcp_data/webots.db a robot writes all the while, and loses no row."""
    folder = tmp_path_factory.mktemp("project")
    database = record(folder / "mcp_data")
    line = [sys.executable, "-c", ROBOT, str(database)]
    robot = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert robot.stdout is not None
    assert robot.stdout.readline() == "recording\n"
    yield folder
    written, dropped, failures = map(int, robot.communicate(timeout=TIMEOUT_S)[0].split())
    assert (dropped, failures) == (0, 0)
    assert written > 0
    with closing(sqlite3.connect(database)) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def run(line: list[str], folder: Path) -> str:
    done = subprocess.run(
        line, cwd=folder, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def program(name: str) -> str:
    """Its path; of this environment before any other."""
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def in_shell(code: str, folder: Path) -> str:
    name = code.split()[0]
    return run(["sh", "-c", code.replace(name, f"'{program(name)}'", 1)], folder)


@pytest.mark.slow
def test_the_sqlite3_shell_shows_where_each_robot_is(project: Path) -> None:
    now, lines = blocks("sqlite3", "sh")
    answer = in_shell(now, project)
    assert "rover" in answer
    assert "writer" in answer
    in_shell(lines, project)
    assert (project / "log.csv").read_text().startswith("robot,run_id,log_id,sim_time_s,utc,level")


def test_datasette_answers_with_json(project: Path) -> None:
    _, get = blocks("Datasette", "sh")
    runs = json.loads(in_shell(get, project))
    assert {run["robot"] for run in runs} == {"rover", "writer"}


def test_datasette_serves_pages_while_the_robot_records(project: Path) -> None:
    serve, _ = blocks("Datasette", "sh")
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    line = [program("datasette"), *serve.replace("8001", str(port)).split()[1:]]
    server = subprocess.Popen(line, cwd=project, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        assert any("Uvicorn running" in text for text in server.stderr)
        address = f"http://127.0.0.1:{port}/webots/robot_now.json?_shape=array"
        rows = [json.load(urllib.request.urlopen(address, timeout=TIMEOUT_S)) for _ in range(2)]
        assert all({row["robot"] for row in answer} == {"rover", "writer"} for answer in rows)
    finally:
        server.terminate()
        server.communicate(timeout=TIMEOUT_S)


def test_pandas_reads_a_trajectory_and_all_values(project: Path) -> None:
    pytest.importorskip("pandas", reason="pandas is not installed")
    track, states = blocks("pandas", "python")
    assert "cruise" in run([sys.executable, "-c", track], project)
    assert "distance_m.left" in run([sys.executable, "-c", states], project)


@pytest.fixture(scope="module")
def duckdb_extension() -> None:
    """What its users fetch once: from a package where that is installed, else from the network."""
    pytest.importorskip("duckdb", reason="duckdb is not installed")
    for way in (OFFLINE, ONLINE):
        line = [sys.executable, "-c", way]
        if (
            subprocess.run(line, capture_output=True, timeout=TIMEOUT_S, check=False).returncode
            == 0
        ):
            return
    pytest.skip("DuckDB's SQLite extension is not installed and cannot be fetched")


@pytest.mark.slow
@pytest.mark.usefixtures("duckdb_extension")
def test_duckdb_reads_the_states(project: Path) -> None:
    [code] = blocks("DuckDB", "python")
    answer = run([sys.executable, "-c", code], project)
    assert "lowest_v" in answer
    assert "12.4" in answer


@pytest.mark.usefixtures("duckdb_extension")
def test_duckdb_reads_every_view_but_those_that_the_page_excepts(project: Path) -> None:
    page = FILE.read_text("utf-8")
    excepted = set(re.findall(r"DuckDB cannot read the view `(\w+)`", page))
    views = sorted(set(re.findall(r"(?m)^- `(robot_\w+)`", page)) - excepted)
    assert excepted and views
    code = (
        "import duckdb\nc = duckdb.connect()\nc.execute('LOAD sqlite')\n"
        "c.execute(\"ATTACH 'mcp_data/webots.db' AS r (TYPE sqlite, READ_ONLY)\")\n"
        f"for view in {views}: print(view, len(c.sql(f'SELECT * FROM r.{{view}}').fetchall()))"
    )
    counts = dict(line.split() for line in run([sys.executable, "-c", code], project).splitlines())
    assert sorted(counts) == views
    empty = {view for view, count in counts.items() if int(count) == 0}
    assert empty <= {"robot_parameter", "robot_statistics"}  # the robot declares no parameter
