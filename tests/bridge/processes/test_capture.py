"""What a controller prints with `capture_output=True`: where it appears, and what is recorded."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.bridge.conftest import Recording
from webots_mcp.bridge.printed_lines import MOST_LINES_PER_S

Script = Callable[..., "subprocess.Popen[str]"]
LINES = "SELECT message FROM log WHERE logger = 'stdout' ORDER BY id"
posix = pytest.mark.skipif(os.name != "posix", reason="as the systems of POSIX do it")

CAPTURED = """
import ctypes, os, signal, subprocess, sys, threading, time
from pathlib import Path
from webots_mcp import MCPBridge
from webots_mcp.standin import InProcessSupervisor

robot = InProcessSupervisor("rover")

def begin():
    return MCPBridge(robot, data_dir=sys.argv[1], capture_output=True)
"""


WITHOUT_POLLING = """
from webots_mcp.bridge import capture, output_channel
capture.POLLS = output_channel.POLLS = False
"""


@pytest.fixture
def run(script: Script, data_dir: Path) -> Callable[[str], subprocess.Popen[str]]:
    return lambda program: script(CAPTURED + program, data_dir)


Run = Callable[[str], "subprocess.Popen[str]"]


@pytest.mark.parametrize("system", ["", WITHOUT_POLLING], ids=["this system", "as on Windows"])
def test_prints_of_python_of_c_and_of_children_come_in_order_and_are_recorded(
    run: Run, filed: Recording, system: str
) -> None:
    process = run(
        system
        + """
bridge = begin()
print("python")
os.write(1, b"descriptor\\n")
print("python again", flush=True)
subprocess.run([sys.executable, "-c", "print('a child')"])
print("an error", file=sys.stderr)
sys.stdout.write("no newline")
"""
    )
    out, err = process.communicate(timeout=60)
    lines = ["python", "descriptor", "python again", "a child", "no newline"]
    assert out == "\n".join(lines)
    assert err == "an error\n"
    assert filed.rows(LINES) == lines
    rows = "SELECT level, source, logger, message FROM log WHERE logger = 'stderr'"
    assert filed.rows(rows) == [("warning", "controller", "stderr", "an error")]


@posix
def test_what_c_code_prints_into_its_own_buffer_is_recorded_at_the_end(
    run: Run, filed: Recording
) -> None:
    process = run('begin()\nctypes.CDLL(None).printf(b"from C\\n")')
    assert process.communicate(timeout=60)[0] == "from C\n"
    assert filed.rows(LINES) == ["from C"]


@posix
@pytest.mark.parametrize(
    ("end", "status"),
    [
        ("os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL),
        ("ctypes.string_at(0)", -signal.SIGSEGV),
        ("os._exit(3)", 3),
    ],
)
def test_the_last_print_before_a_crash_is_seen_and_recorded(
    run: Run, filed: Recording, end: str, status: int
) -> None:
    process = run(f'begin()\nprint("the last words", flush=True)\n{end}')
    out, _ = process.communicate(timeout=60)
    assert process.returncode == status
    assert out == "the last words\n"
    assert filed.rows(LINES) == ["the last words"]


def test_an_exception_that_ends_the_controller_is_recorded_with_its_traceback(
    run: Run, filed: Recording
) -> None:
    process = run("begin()\n1 / 0")
    _, err = process.communicate(timeout=60)
    assert "ZeroDivisionError: division by zero" in err
    printed = filed.rows("SELECT message FROM log WHERE logger = 'stderr' ORDER BY id")
    assert printed[0].startswith("Traceback")
    assert printed[-1] == "ZeroDivisionError: division by zero"


@pytest.mark.slow
def test_a_reader_that_reads_nothing_keeps_no_print_waiting(
    run: Run, filed: Recording, tmp_path: Path
) -> None:
    """150 kB are more than one pipe holds: without the bridge they would wait."""
    done = tmp_path / "done"
    process = run(
        f"""
begin()
for n in range(150):
    print(n, "x" * 1000, flush=True)
Path({str(done)!r}).touch()
sys.stdin.readline()
"""
    )
    assert process.stdin is not None
    while not done.exists():
        assert process.poll() is None
    out, _ = process.communicate("go on\n", timeout=30)
    assert [line.split()[0] for line in out.splitlines()] == [str(n) for n in range(150)]
    assert len(filed.rows(LINES)) == 150


@pytest.mark.slow
def test_a_flood_of_lines_is_passed_on_whole_and_what_was_not_recorded_is_counted(
    run: Run, filed: Recording
) -> None:
    count = 20_000
    process = run(f"begin()\nfor n in range({count}):\n    print(n)")
    out, _ = process.communicate(timeout=60)
    assert out.splitlines() == [str(n) for n in range(count)]
    lines = filed.rows(LINES)
    notes = [line for line in lines if line.startswith("(")]
    left_out = sum(int(note[1:].split()[0]) for note in notes)
    assert all(f"more than {MOST_LINES_PER_S} were printed in a second" in note for note in notes)
    assert left_out > 0
    assert len(lines) - len(notes) + left_out == count


def test_a_line_without_end_is_cut_and_passed_on_whole(run: Run, filed: Recording) -> None:
    process = run('begin()\nsys.stdout.write("x" * 3_000_000)\nprint()\nprint("next")')
    out, _ = process.communicate(timeout=60)
    assert out == "x" * 3_000_000 + "\nnext\n"
    long, following = filed.rows(LINES)
    assert 10_000 <= len(long) < 10_100
    assert following == "next"


def test_a_progress_bar_is_recorded_as_it_looks_at_the_end(run: Run, filed: Recording) -> None:
    run('begin()\nfor n in range(3): print(n, end="\\r")\nprint("\\n\\ndone\\r")').communicate()
    assert filed.rows(LINES) == ["2", "done"]


def test_close_puts_everything_back(run: Run, filed: Recording) -> None:
    process = run(
        """
before = sys.stdout, os.fstat(1), sys.stderr, os.fstat(2)
bridge = begin()
assert sys.stdout is not before[0]
print("recorded")
bridge.close()
assert sys.stdout is before[0] and sys.stderr is before[2]
assert os.path.samestat(os.fstat(1), before[1]) and os.path.samestat(os.fstat(2), before[3])
print("not recorded")
deadline = time.monotonic() + 60
while any("std" in thread.name for thread in threading.enumerate()):
    assert time.monotonic() < deadline
"""
    )
    out, err = process.communicate(timeout=60)
    assert (out, err) == ("recorded\nnot recorded\n", "")
    assert filed.rows(LINES) == ["recorded"]


@pytest.mark.parametrize("close", ["sys.stdout.close()", "with sys.stdout: pass"])
def test_stdout_that_python_closes_is_recorded_up_to_there(
    run: Run, filed: Recording, close: str
) -> None:
    process = run(f'bridge = begin()\nprint("the last line")\n{close}\nbridge.close()')
    assert process.communicate(timeout=60) == ("the last line\n", "")
    assert filed.rows(LINES) == ["the last line"]


@posix
def test_stdout_that_somebody_closed_or_led_elsewhere_is_left_alone(
    run: Run, filed: Recording, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    process = run(
        f"""
bridge = begin()
print("before", flush=True)
file = os.open({str(elsewhere)!r}, os.O_WRONLY | os.O_CREAT)
os.dup2(file, 1)
os.close(2)
bridge.close()
os.write(1, b"still elsewhere")
os._exit(7)
"""
    )
    assert process.communicate(timeout=60)[0] == "before\n"
    assert process.returncode == 7
    assert elsewhere.read_text("utf-8") == "still elsewhere"
    assert filed.rows(LINES) == ["before"]


@pytest.mark.parametrize("strict", ["", "1"])
def test_what_cannot_be_recorded_is_passed_on_all_the_same(run: Run, strict: str) -> None:
    """More of it than the pipe holds."""
    process = run(
        f"""
os.environ["WEBOTS_MCP_STRICT"] = {strict!r}
import threading
from webots_mcp.bridge.journal import Journal

failed = threading.Semaphore(0)

def fail(*_):
    failed.release()
    raise OSError("no room")

bridge = begin()
Journal.output = fail
for n in range(40):
    os.write(1, b"x" * 99_999 + b"\\n")
assert failed.acquire(timeout=30)
os.write(1, b"y\\n")  # the second failure begins when the first one has been told
assert failed.acquire(timeout=30)
Journal.output = lambda *_: None
"""
    )
    out, err = process.communicate(timeout=90)
    assert len(out) == 4_000_002
    assert "no room" in err


@posix
def test_capturing_again_and_again_leaves_no_descriptor_open(run: Run, filed: Recording) -> None:
    process = run(
        """
begin().close()
before = len(os.listdir("/dev/fd"))
for n in range(3):
    bridge = begin()
    print(n)
    bridge.close()
    deadline = time.monotonic() + 60
    while len(os.listdir("/dev/fd")) > before:
        assert time.monotonic() < deadline
"""
    )
    out, err = process.communicate(timeout=60)
    assert (out, err) == ("0\n1\n2\n", "")
    assert filed.rows(LINES) == ["0", "1", "2"]


@posix
def test_a_forked_child_prints_where_its_parent_did_before(run: Run, filed: Recording) -> None:
    process = run(
        """
sys.stdout.reconfigure(write_through=False, line_buffering=False)
bridge = begin()
print("parent")  # waits in a buffer of Python's, which the child has as well
if os.fork() == 0:
    os.write(1, b"child\\n")
    os._exit(0)
os.wait()
print("parent again")
"""
    )
    out, _ = process.communicate(timeout=60)
    assert out.splitlines() == ["child", "parent", "parent again"]
    assert filed.rows(LINES) == ["parent", "parent again"]


def test_the_output_of_a_process_is_recorded_once(run: Run, filed: Recording) -> None:
    process = run(
        """
first = begin()
second = MCPBridge(InProcessSupervisor("rover"), data_dir=sys.argv[1], capture_output=True)
print("once")
second.close()
print("and after the other was closed")
"""
    )
    out, err = process.communicate(timeout=60)
    assert "another bridge of this process records its output already" in err
    assert filed.rows(LINES) == out.splitlines()


def test_a_stream_of_somebodys_own_is_recorded_and_gets_what_it_got(
    run: Run, filed: Recording
) -> None:
    """As Webots' package puts one there on Windows."""
    process = run(
        """
class Own:
    written = []
    def write(self, text):
        self.written.append(text)
    def flush(self):
        pass

real, sys.stdout = sys.stdout, Own()
begin()
print("to my own")
print("".join(Own.written), end="", file=real)
"""
    )
    assert process.communicate(timeout=60)[0] == "to my own\n"
    assert filed.rows(LINES) == ["to my own", "to my own"]


@posix
def test_a_process_without_stdout_is_recorded_all_the_same(run: Run, filed: Recording) -> None:
    process = run(
        """
os.close(1)
bridge = begin()
bridge.publish({"n": 1}, force=True)
print("into the void", flush=True)
"""
    )
    assert process.communicate(timeout=60) == ("", "")
    assert filed.states() == [{"n": 1}]
    assert "into the void" in filed.rows(LINES)


@posix
def test_an_old_place_that_is_gone_ends_neither_controller_nor_record(
    run: Run, filed: Recording
) -> None:
    process = run(
        """
begin()
sys.stdin.readline()
for n in range(3):
    print(n, flush=True)
"""
    )
    with process:
        assert process.stdout is not None
        assert process.stdin is not None
        process.stdout.close()
        process.stdin.write("go on\n")
    assert process.returncode == 0
    assert [line for line in filed.rows(LINES) if line.isdigit()] == ["0", "1", "2"]
    assert "(stdout cannot be written any more: Broken pipe)" in filed.rows(LINES)


@pytest.mark.skipif(sys.platform != "linux", reason="where a pipe can be made so large")
def test_c_code_that_holds_the_interpreter_may_print_half_a_megabyte(
    run: Run, filed: Recording
) -> None:
    process = run(
        """
begin()
libc = ctypes.PyDLL(None)  # it does not let other threads of Python run meanwhile
for n in range(5):
    libc.write(1, b"x" * 99_999 + b"\\n", 100_000)
"""
    )
    assert len(process.communicate(timeout=60)[0]) == 500_000
    assert len(filed.rows(LINES)) == 5
