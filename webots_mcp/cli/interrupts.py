"""End a command early, by Ctrl-C or by SIGTERM.

Both clean up in the same way, and end the process after a short time in any case.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator
from types import FrameType
from typing import Final, TypeAlias

_WORDS: Final = {signal.SIGINT: "ended by Ctrl-C", signal.SIGTERM: "ended by SIGTERM"}
Handler: TypeAlias = Callable[[int, "FrameType | None"], None]


@contextlib.contextmanager
def ending_by_signals(*, is_process: bool) -> Generator[None]:
    """Let SIGTERM clean up like Ctrl-C: by a KeyboardInterrupt, which carries the signal.

    A process that SIGTERM has not ended after 2.5 s, because one of its threads still works, ends
    at once: the database rolls back what was being written.

    Args:
        is_process: The command is all that the process does, to the exit of the interpreter, which
            waits for threads.

    Before Python 3.11 anyio's own handling of Ctrl-C ends with a CancelledError.
    """
    as_well = (signal.SIGINT,) if sys.version_info < (3, 11) else ()
    late: list[threading.Timer] = []

    def end(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGTERM and not late:
            late.append(threading.Timer(2.5, _exit, [number]))
            late[0].daemon = True
            late[0].start()
        _interrupt(number, frame)

    try:
        with _handling(end, signal.SIGTERM, *as_well):
            yield
    finally:
        for timer in late * (not is_process):
            timer.cancel()


@contextlib.contextmanager
def ending_by_event(stopping: threading.Event) -> Generator[None]:
    """Let a signal only set an event, and end the command when the watcher of the event is done.

    This is for work in threads: two exceptions from signal handlers break the locks that they
    interrupt. A second signal ends the process at once.
    """
    came: list[int] = []

    def end(number: int, _: FrameType | None) -> None:
        if came:
            _exit(number)
        came.append(number)
        threading.Thread(target=stopping.set).start()  # this thread may already hold the lock

    try:
        with _handling(end, *_WORDS):
            yield
    finally:
        if came:
            raise KeyboardInterrupt(came[0])


@contextlib.contextmanager
def ending_in_time() -> Generator[None]:
    """End the process within half a second of a signal, whatever its threads wait for.

    A thread that reads from a terminal waits for the next line, which nobody will type.
    """
    import logging  # imported here, because most commands do without it

    def end(number: int, frame: FrameType | None) -> None:
        # A task that the interrupt ends halfway is no defect that a person has to read about.
        logging.getLogger("asyncio").disabled = True
        late = threading.Timer(0.5, _exit, [number])
        late.daemon = True
        late.start()
        _interrupt(number, frame)

    with _handling(end, *_WORDS):
        try:
            yield
        except KeyboardInterrupt as interrupt:
            _exit(*interrupt.args)


@contextlib.contextmanager
def _handling(handler: Handler, *numbers: int) -> Generator[None]:
    """Handle signals, except in a thread that does not receive them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = [(number, signal.signal(number, handler)) for number in numbers]
    try:
        yield
    finally:
        for number, handled in before:
            signal.signal(number, handled)


def ended_by(interrupt: KeyboardInterrupt) -> tuple[int, str]:
    """Return the exit code of a process that a signal has ended, and the signal in words."""
    number = signal.Signals(interrupt.args[0] if interrupt.args else signal.SIGINT)
    return 128 + number, _WORDS[number]


def _interrupt(number: int, _: FrameType | None) -> None:
    raise KeyboardInterrupt(number)


def _exit(number: int) -> None:
    code, word = ended_by(KeyboardInterrupt(number))
    with contextlib.suppress(OSError):
        print(f"webots-mcp: {word}", file=sys.stderr, flush=True)
    os._exit(code)
