"""Run a simulator for as long as its starter lives: `python program_keeper.py COMMAND...`.

The keeper starts the command when it reads a byte from its standard input, and ends it when that
input ends. The input ends when the starter closes it or dies, in whatever way. The keeper runs in a
Python process of its own that loads little else. If the keeper itself is killed, Linux ends the
command. On other systems the starter ends it, so it survives only if both are killed at once.
"""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from types import FrameType

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_STDIN = 0  # not sys.stdin, whose lock a thread that reads would hold when Python ends
_SIGNALLED = 128  # added to the number of the signal that ended a command, as shells do
GRACE_S = 5.0  # Webots gives its controllers 1 s, and ends them after another


def main(command: list[str]) -> int:
    """Run a command; return its exit code, or 0 if it was never started."""
    signal.signal(signal.SIGTERM, _leave_it_to_the_simulator)
    _lead_a_group()
    if not os.read(_STDIN, 1):
        return 0
    ask_first = _end_with_keeper()
    simulator = subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=ask_first)
    threading.Thread(target=_end_with_input, args=(simulator,), daemon=True).start()
    code = simulator.wait()
    if os.name == "posix":
        os.killpg(os.getpgrp(), signal.SIGTERM)  # controllers that remained after a crash
    return code if code >= 0 else _SIGNALLED - code


def _lead_a_group() -> None:
    """Begin a process group for the simulator and its controllers, without `xvfb-run`."""
    if os.name == "posix" and os.getpgrp() != os.getpid():
        os.setpgid(0, 0)


def _end_with_keeper() -> Callable[[], object] | None:
    """Return what the command's process calls first, so that it does not outlive this one."""
    if sys.platform != "linux":
        return None
    import ctypes

    set_option, keeper = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        set_option(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != keeper:  # it ended a moment ago
            os.kill(os.getpid(), signal.SIGTERM)

    return ask


def _leave_it_to_the_simulator(number: int, frame: FrameType | None) -> None:
    """Ignore a signal, which the whole process group receives: the simulator ends by it."""


def _end_with_input(simulator: "subprocess.Popen[bytes]") -> None:
    while os.read(_STDIN, 1):
        pass
    _ask_to_end(simulator)
    try:
        simulator.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        _end(simulator)


def _ask_to_end(simulator: "subprocess.Popen[bytes]") -> None:
    """Ask the simulator to end; Webots then answers -1 to the steps of its controllers."""
    if sys.platform == "win32":
        _run(windows_command(simulator.pid, hard=False))
    else:
        simulator.terminate()


def _end(simulator: "subprocess.Popen[bytes]") -> None:
    """Kill the simulator with its process group, since Webots is a script that starts a program."""
    if sys.platform == "win32":
        _run(windows_command(simulator.pid, hard=True))
        simulator.kill()
    else:
        os.killpg(os.getpgrp(), signal.SIGKILL)


def windows_command(pid: int, *, hard: bool) -> list[str]:
    """Return the command that ends a process and its children; without `hard` it may refuse."""
    return ["taskkill", "/T", *(["/F"] if hard else []), "/PID", str(pid)]


def _run(command: list[str]) -> None:
    with contextlib.suppress(OSError):  # taskkill is missing: the process is ended by force only
        subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
