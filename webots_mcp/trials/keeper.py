"""Runs a simulator for as long as whoever started it lives: `python keeper.py COMMAND...`.

It starts the command when it reads a byte from its standard input, and ends it when that input
ends: it is closed by who holds the other end, or with him, however he dies. It runs in a Python of
its own that loads little else. Where the keeper itself is killed, Linux ends the command; elsewhere
it takes who started the keeper, and outlives both only where both are killed at once.
"""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from types import FrameType

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_STDIN = 0  # not sys.stdin, whose lock a thread that reads would hold when Python ends
GRACE_S = 5.0  # Webots gives its controllers 1 s, and ends them after another


def main(command: list[str]) -> int:
    """Keep a command; returns its exit code, and 0 where it was never told to start it."""
    signal.signal(signal.SIGTERM, _leave_it_to_the_simulator)
    if not os.read(_STDIN, 1):
        return 0
    ask_first = _end_with_keeper()
    simulator = subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=ask_first)
    threading.Thread(target=_end_with_input, args=(simulator,), daemon=True).start()
    return simulator.wait()


def _end_with_keeper() -> Callable[[], object] | None:
    """What the command's process asks for first, so that it does not outlive this one."""
    if sys.platform != "linux":
        return None
    import ctypes

    set_option, keeper = ctypes.CDLL(None).prctl, os.getpid()

    def ask() -> None:
        set_option(_PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != keeper:  # it died a moment ago
            os.kill(os.getpid(), signal.SIGTERM)

    return ask


def _leave_it_to_the_simulator(number: int, frame: FrameType | None) -> None:
    """A signal goes to all of the process group."""


def _end_with_input(simulator: subprocess.Popen[bytes]) -> None:
    while os.read(_STDIN, 1):
        pass
    _end(simulator, hard=False)
    try:
        simulator.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        _end(simulator, hard=True)


def _end(simulator: subprocess.Popen[bytes], *, hard: bool) -> None:
    """With all of its process group, which is ours: Webots is a script that starts the program."""
    if sys.platform == "win32":
        simulator.kill()
    else:
        os.killpg(os.getpgrp(), signal.SIGKILL if hard else signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
