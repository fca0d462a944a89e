"""Controllers in C and C++ record by webots_mcp.h, whatever happens to them and around them."""

from __future__ import annotations

import errno
import json
import math
import os
import random
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client

from tests.exploring import attempts
from tests.waiting import wait_for
from webots_mcp.cli import main
from webots_mcp.contract import C_HEADER, LOG_CHARACTERS
from webots_mcp.database.waiting_file import journal_parts
from webots_mcp.server.mcp_server import create_server
from webots_mcp.store.recording import RecordingAccess

HERE = Path(__file__).parent
STRICT = ["-O1", "-Wall", "-Wextra", "-Werror", "-pedantic", "-DWMCP_PART_BYTES=30000"]
CHECKED = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
LANGUAGES = {
    "c99": ["gcc", "-std=c99", "-Wconversion"],
    "c++11": ["g++", "-std=c++11", "-x", "c++"],
}


@pytest.fixture(scope="module", params=LANGUAGES)
def language(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def driver(language: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The driver in C or in C++, under sanitizers."""
    return built(language, "driver.c", tmp_path_factory.mktemp("built"))


def built(language: str, source: str, folder: Path) -> Path:
    compiler, *options = LANGUAGES[language]
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    flags = [*options, *STRICT, *CHECKED, f"-I{C_HEADER.parent}"]
    subprocess.run([compiler, *flags, HERE / source, "-o", folder / "program"], check=True)
    return folder / "program"


Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def start(driver: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts the driver; its data folder is the test's."""
    begun: list[subprocess.Popen[str]] = []

    def started(*arguments: str, **options: Any) -> subprocess.Popen[str]:
        folder = str(options.pop("folder", tmp_path))
        environment = os.environ | {"WEBOTS_MCP_DATA_DIR": folder} | options.pop("env", {})
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        begun.append(subprocess.Popen([driver, *arguments], env=environment, **pipes, **options))
        return begun[-1]

    yield started
    for process in begun:
        process.kill()
        process.communicate()


def do(process: subprocess.Popen[str], *lines: str) -> None:
    """Have the driver make these calls, and wait until it has."""
    assert process.stdin and process.stdout
    process.stdin.write("\n".join([*lines, "say", ""]))
    process.stdin.flush()
    assert process.stdout.readline() == "said\n"


def end(process: subprocess.Popen[str]) -> None:
    process.communicate()
    assert process.returncode == 0


def read(folder: Path, sql: str) -> list[Any]:
    """Through a recording, as a question reads."""
    with RecordingAccess(folder / "webots.db", folder).reader() as connection:
        return connection.execute(sql).fetchall()


def hexed(data: bytes | str) -> str:
    return (data.encode() if isinstance(data, str) else data).hex() or "00"


def bits_of(value: float) -> str:
    return struct.pack(">d", value).hex()


@pytest.mark.slow
def test_every_number_is_read_back_to_the_last_bit(start: Start) -> None:
    process = start("numbers", "50000")
    assert process.stdout
    lines = [line.split() for line in process.stdout]
    assert len(lines) > 45_000
    wrong = [text for bits, text in lines if bits_of(json.loads(text)) != bits]
    assert wrong == []
    assert max(len(text) for _, text in lines) < 30


def test_a_state_is_what_python_would_have_recorded(start: Start, tmp_path: Path) -> None:
    process = start()
    calls = [
        "begin 0.032",
        *(
            f"number {hexed(n)} {bits_of(v)}"
            for n, v in [("a.b", 0.1), ("a.c", -0.0), ("d", 5e-324)]
        ),
        *(f"number {hexed(n)} {bits_of(v)}" for n, v in [("n", math.nan), ("m.i", -math.inf)]),
        f"integer {hexed('i')} ffffffffffffffff",
        f"flag {hexed('f')} 2",
        f"text {hexed('t')} {hexed(chr(34) + chr(92) + chr(10) + 'ü🤖')}",
        f"text {hexed('none')} -",
        f"array {hexed('pose')} 3 0.3",
        f"array {hexed('empty')} 0 1.0",
        f"array {hexed('odd')} 7 2.5",
        f"array {hexed('nans')} 2 nan",
        f"array {hexed('long')} 20001 1.0",
        f"floats {hexed('range')} 0.3",
        f"text {hexed('big')} {hexed('ü' * 60_000)}",
        f"number - {bits_of(1.0)}",
        "publish",
        "publish",
        f"log {hexed('wheel' + chr(9) + 'slips')}",
        "begin nan",
        "begin 0.0",
        f"integer {hexed('i')} 7",
        "publish",
    ]
    do(process, *calls)
    end(process)
    (text, replaced), (second, _) = read(tmp_path, "SELECT data, replaced FROM state ORDER BY id")
    third = struct.unpack("f", struct.pack("f", struct.unpack("f", struct.pack("f", 0.3))[0] / 3))[
        0
    ]
    state = json.loads(text)
    assert len(state.pop("big").encode()) == 100_000
    assert state == {
        "a": {"b": 0.1, "c": -0.0}, "d": 5e-324, "n": None, "m": {"i": None}, "i": -1, "f": True,
        "t": '"\\\nü🤖', "none": None, "pose": [0.3, 0.3, 0.3], "empty": [],
        "odd": [2.5, 2.5, 2.5, None, 2.5, 2.5, 2.5], "nans": [None, None], "long": None,
        "range": [struct.unpack("f", struct.pack("f", 0.3))[0], third],
    }  # fmt: skip
    assert json.loads(replaced) == {
        "n": "nan", "m.i": "-inf", "odd.*": "-inf", "nans.*": "nan", "long": "too large",
        "big": "too large",
    }  # fmt: skip
    assert json.loads(second) == {"i": 7}
    runs = read(tmp_path, "SELECT start_reason, end_reason, world, basic_time_step_ms FROM run")
    assert runs == [
        ("start", "reset", "/w/arena.wbt", 32.0),
        ("reset", "finished", "/w/arena.wbt", 32.0),
    ]
    assert read(tmp_path, "SELECT kind FROM event") == [("reset",)]
    assert read(tmp_path, "SELECT level, message FROM log") == [("warning", "wheel\tslips")]
    assert read(tmp_path, "SELECT pid, end_reason FROM session") == [(process.pid, "finished")]
    assert read(tmp_path, "SELECT role FROM signal WHERE name = 'pose.2'") == [("yaw",)]


@pytest.mark.parametrize("step_ms", ["nan", "inf", "-inf", "1e308", "-1e308", "0", "-32", "4e-324"])
def test_a_time_step_of_any_size_is_recorded_or_null(
    start: Start, tmp_path: Path, step_ms: str
) -> None:
    process = start("step", step_ms)
    do(process, "begin 0.5", f"integer {hexed('i')} 7", "publish")
    end(process)
    (row,) = read(tmp_path, "SELECT basic_time_step_ms, started_sim_time_s FROM run")
    assert row[0] == (float(step_ms) if math.isfinite(float(step_ms)) else None)
    assert 0.0 <= row[1] <= 0.5
    assert read(tmp_path, "SELECT data FROM state") == [('{"i":7}',)]
    assert read(tmp_path, "SELECT rows_dropped, end_reason FROM session") == [(0, "finished")]


SEEDS = {"c99": "1", "c++11": "2"}


@pytest.mark.slow
def test_no_number_and_no_text_crashes_a_function_or_makes_a_line_that_does_not_fit(
    language: str, tmp_path: Path
) -> None:
    program = built(language, "hostile.c", tmp_path)
    folder = tmp_path / "data"
    environment = os.environ | {"WEBOTS_MCP_DATA_DIR": str(folder)}
    command = [program, SEEDS[language], "12", "150"]
    done = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"well\n", b"")
    RecordingAccess(folder / "webots.db", folder).ingest()
    assert journal_parts(folder / "webots.db") == {}
    assert read(folder, "SELECT count(*) > 0 FROM state") == [(1,)]
    whys = read(folder, "SELECT json_extract(data, '$.why') FROM event WHERE kind = 'dropped'")
    assert [why for (why,) in whys if "there is no level" not in why] == []


def test_names_and_texts_of_any_bytes_are_recorded(start: Start, tmp_path: Path) -> None:
    draw = random.Random(1)
    process, rows = start(), 150
    for row in range(rows):
        texts = [
            (draw.randbytes(draw.choice([1, 5, 300])), draw.randbytes(draw.randrange(40)))
            for _ in range(draw.randrange(6))
        ]
        lines = [f"text {hexed(name)} {hexed(text)}" for name, text in texts]
        do(
            process,
            f"begin {row}",
            *lines,
            f"log {hexed(texts[0][1] if texts else b'x')}",
            "publish",
        )
    end(process)
    states = read(tmp_path, "SELECT data, replaced FROM state")
    assert len(states) == rows and all(isinstance(json.loads(data), dict) for data, _ in states)
    assert any("not UTF-8" in (replaced or "") for _, replaced in states)
    assert read(tmp_path, "SELECT count(*) FROM log") == [(rows,)]
    assert read(tmp_path, "SELECT count(*) FROM event WHERE kind = 'dropped'") == [(0,)]


def test_a_locale_with_another_decimal_point_changes_no_number(
    start: Start, tmp_path: Path
) -> None:
    """Where the machine has such a locale; else it is the usual one."""
    process = start(env={"LC_ALL": "de_DE.UTF-8"})
    values = [1e300, 2.5e17, 1e-300, 0.1]
    lines = [f"number {hexed(f'v{i}')} {bits_of(value)}" for i, value in enumerate(values)]
    do(process, "begin 1", *lines, "publish")
    end(process)
    ((text,),) = read(tmp_path, "SELECT data FROM state")
    assert [*json.loads(text).values()] == values


READER = """
import sys, time
from pathlib import Path
from webots_mcp.store.recording import RecordingAccess
folder = Path(sys.argv[1])
print("ready", flush=True)
while True:
    RecordingAccess(folder / "webots.db", folder).ingest()
    time.sleep(0.001)
"""


KILLED_AFTER = {  # rows, in each attempt
    "c99": [30, 300, 1000] + [random.randrange(1, 3000) for _ in range(attempts(0, exploring=50))],
    "c++11": [300] + [random.randrange(1, 3000) for _ in range(attempts(0, exploring=20))],
}


@pytest.mark.slow
def test_kills_lose_nothing_and_double_nothing(start: Start, language: str, tmp_path: Path) -> None:
    """With two readers, which are killed as well, and journals of several parts."""
    for attempt, published in enumerate(KILLED_AFTER[language]):
        folder = tmp_path / str(attempt)
        writer = start("forever", "100000", folder=folder)
        command = [sys.executable, "-c", READER, str(folder)]
        readers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        for reader in readers:
            assert reader.stdout and reader.stdout.readline()
        assert writer.stdout
        while int(writer.stdout.readline()) < published:
            pass
        readers[0].kill()
        writer.kill()
        told = published + len(writer.stdout.read().splitlines())
        readers[1].kill()
        for reader in readers:
            reader.communicate()
        while journal_parts(folder / "webots.db"):  # one answer has no time for thousands of rows
            RecordingAccess(folder / "webots.db", folder).ingest()
        found = [
            n for (n,) in read(folder, "SELECT json_extract(data, '$.i') FROM state ORDER BY id")
        ]
        assert found[:told] == [*range(1, told + 1)]
        assert len(found) in (told, told + 1)
        changes = read(folder, "SELECT count(*) FROM event WHERE kind = 'change'")
        assert changes == [(len(found) // 50,)]
        assert read(folder, "SELECT count(*), max(uuid) FROM run")[0][0] == 1
        assert read(folder, "SELECT count(*) FROM session") == [(1,)]
        with RecordingAccess(folder / "webots.db", folder).view() as view:
            assert not view.robot.live and "killed or crashed" in (view.status.why or "")


def test_a_living_controller_is_live_and_its_complete_parts_are_deleted(
    start: Start, tmp_path: Path
) -> None:
    process = start()
    long = f"text {hexed('t')} {hexed('x' * 1000)}"  # thirty fill a part
    do(process, *(f"begin {i}\n{long}\npublish" for i in range(1, 201)))
    assert len(read(tmp_path, "SELECT 1 FROM state")) == 200
    (parts,) = journal_parts(tmp_path / "webots.db").values()
    assert len(parts) == 1 and int(parts[0].stem[-4:]) > 5
    with RecordingAccess(tmp_path / "webots.db", tmp_path).view() as view:
        assert view.robot.live and view.status.is_moving
        assert view.run and view.run.row_count == 200 and view.run.ended_wall_time_s is None
    assert read(tmp_path, "SELECT typeof(process), instance FROM session")[0][0] == "text"
    end(process)


@pytest.mark.slow
def test_what_a_full_disk_cost_is_counted_and_reported(start: Start, tmp_path: Path) -> None:
    process = start()
    row = ["integer {} {:x}".format(hexed("i"), 7), "publish"]
    do(process, "begin 1", *row)
    (part,) = journal_parts(tmp_path / "webots.db").popitem()[1]
    full = part.stat().st_size + 70  # a part of a line
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (full, resource.RLIM_INFINITY))
    do(process, *(line for n in range(2, 12) for line in (f"begin {n}", *row)))
    assert part.stat().st_size < full
    resource.prlimit(
        process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    )
    count = iter(range(12, 10_000))

    def reported() -> list[Any]:
        do(process, f"begin {next(count)}", *row)
        return read(tmp_path, "SELECT data FROM event WHERE kind = 'dropped'")

    ((data,),) = wait_for(reported)
    lost = json.loads(data)["row_count"]
    assert json.loads(data)["why"] == os.strerror(errno.ENOSPC)
    end(process)
    ((states, last),) = read(tmp_path, "SELECT count(*), max(sim_time_s) FROM state")
    assert lost >= 10 and states + lost == last
    assert read(tmp_path, "SELECT rows_dropped, end_reason FROM session") == [(lost, "finished")]


@pytest.mark.parametrize("loss", ["a file in its place", "folder deleted", "database deleted"])
def test_a_folder_that_is_missing_stops_nothing(start: Start, tmp_path: Path, loss: str) -> None:
    folder = tmp_path / "deep" / "data"
    if loss == "a file in its place":
        folder.parent.write_text("in the way")
    process = start(folder=folder)
    do(process, "begin 1", f"integer {hexed('i')} 1", "publish")
    if loss == "a file in its place":
        folder.parent.unlink()
    else:
        assert read(folder, "SELECT count(*) FROM state") == [(1,)]
        if loss == "folder deleted":
            shutil.rmtree(folder)
        else:
            for file in folder.glob("webots.db*"):
                if "waiting" not in file.name:
                    file.unlink()
    count = iter(range(2, 10_000))

    def recorded() -> list[Any]:
        do(process, f"begin {next(count)}", f"integer {hexed('i')} 2", "publish")
        if not journal_parts(folder / "webots.db"):
            return []
        return read(folder, "SELECT json_extract(data, '$.i') FROM state ORDER BY id")

    assert wait_for(recorded)[:2] == ([(1,), (2,)] if loss == "database deleted" else [(2,)])[:2]
    dropped = read(folder, "SELECT count(*) FROM event WHERE kind = 'dropped'")
    assert dropped == [(int(loss == "a file in its place"),)]
    end(process)
    assert read(folder, "SELECT count(*) FROM run WHERE end_reason = 'finished'") == [(1,)]


def test_the_header_cuts_a_log_line_where_python_does() -> None:
    header = C_HEADER.read_text("utf-8")
    assert f"#define WMCP_MAX_LOG {LOG_CHARACTERS}\n" in header


def test_the_command_writes_the_header_and_no_other_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["header", str(tmp_path)]) == 0
    file = tmp_path / "webots_mcp.h"
    assert file.read_bytes() == C_HEADER.read_bytes()
    file.write_text(file.read_text()[:100])
    assert main(["header", str(file), "--json"]) == 0
    assert file.read_bytes() == C_HEADER.read_bytes()
    (tmp_path / "mine.h").write_text("#define MINE")
    assert main(["header", str(tmp_path / "mine.h")]) == 2
    assert "was not changed" in capsys.readouterr().err
    assert main(["header", str(tmp_path / "mistyped")]) == 2
    assert "neither a folder nor a file named *.h" in capsys.readouterr().err
    assert len(C_HEADER.read_text().splitlines()) <= 600


@pytest.mark.slow
@pytest.mark.anyio
@pytest.mark.parametrize("anyio_backend", ["asyncio"])
async def test_a_server_that_began_before_the_database_answers_what_was_just_published(
    start: Start, tmp_path: Path
) -> None:
    async with Client(create_server(tmp_path / "webots.db", tmp_path)) as client:
        process = start()
        for i in range(1, 4):
            do(process, f"begin {i}", f"integer {hexed('front.i')} {i}", "publish")
            answer = (await client.call_tool("webots_get_robot_state", {})).structured_content
            assert answer and answer["sim_time_s"] == i and answer["robot"] == "rover"
        for name, arguments in (
            ("webots_simulation_control", {"command": "pause"}),
            ("webots_send_command", {"action": "dance"}),
            ("webots_list_commands", {}),
            ("webots_list_commands", {"what": "parameters"}),
            ("webots_diagnose_setup", {}),
        ):  # nothing waits for it, and nothing advises what C cannot do
            said = str((await client.call_tool(name, arguments)).content)
            assert "get_command()" not in said and "bridge.parameter" not in said
            assert "no bridge" in said or name == "webots_diagnose_setup"
        process.kill()
        process.communicate()
        while journal_parts(
            tmp_path / "webots.db"
        ):  # it is taken in and deleted without a question
            await anyio.sleep(0.05)
        answer = (await client.call_tool("webots_get_robot_state", {})).structured_content
        assert answer and "killed or crashed" in answer["why"]
