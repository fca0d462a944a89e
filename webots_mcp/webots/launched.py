"""A Webots that this process has started, and its console."""

from __future__ import annotations

import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import IO, TYPE_CHECKING, Final

from webots_mcp.webots.command_line import Start
from webots_mcp.webots.instances import Instance, instances
from webots_mcp.webots.kept_program import KeptProgram
from webots_mcp.webots.stream import Address, ConsoleLine

if TYPE_CHECKING:
    import psutil

_KEPT_LINES: Final = 200
_LOOK_EVERY_S: Final = 0.5  # at all processes of this machine
_LAST_WORDS_S: Final = 1.0  # a child that it left behind may hold its console open
_KEEP_LAYOUT: Final = "WEBOTS_DISABLE_SAVE_SCREEN_PERSPECTIVE_ON_CLOSE"

Show = Callable[[ConsoleLine], None]


class LaunchedWebots(KeptProgram):
    """A Webots that ends with this process at the latest; `start` lets it run.

    Args:
        start: How it is started.
        environment: What it gets beside this process' environment.
        show: Called with each line of its console, in a thread of its own.

    Raises:
        CommandRefusedError: There is no Webots, or no display.
    """

    def __init__(self, start: Start, environment: Mapping[str, str], show: Show) -> None:
        unseen = {_KEEP_LAYOUT: "1"} if start.headless else {}  # the window's layout stays as it is
        command = start.command_line()
        super().__init__(command, {**unseen, **environment}, subprocess.PIPE, subprocess.PIPE)
        self._show = show
        self._lines = deque[ConsoleLine](maxlen=_KEPT_LINES)
        self._instance: Instance | None = None
        self._look_again_s = 0.0
        self._readers = [
            threading.Thread(target=self._read, args=(name, pipe), daemon=True)
            for name, pipe in (("stdout", self._process.stdout), ("stderr", self._process.stderr))
        ]
        for reader in self._readers:
            reader.start()

    @property
    def lines(self) -> list[ConsoleLine]:
        """The newest lines of its console."""
        return list(self._lines)

    @property
    def instance(self) -> Instance | None:
        """As the system sees it; None before it listens, and where the system does not tell."""
        if self._instance is None and time.monotonic() > self._look_again_s:
            self._look_again_s = time.monotonic() + _LOOK_EVERY_S
            pids = self.pids
            found = (each for each in instances() if each.is_listening and each.pid in pids)
            self._instance = next(found, None)
        return self._instance

    @property
    def address(self) -> Address | None:
        """Where it listens; None before it does, and where the system does not tell."""
        return self.instance.address if self.instance else None

    def address_now(self) -> Address | None:
        """The same, looked for at once."""
        self._look_again_s = 0.0
        return self.address

    @property
    def pids(self) -> set[int]:
        """All processes of it: programs and controllers."""
        import psutil

        with suppress(psutil.Error):
            family: list[psutil.Process] = psutil.Process(self.pid).children(recursive=True)
            return {self.pid, *(each.pid for each in family)}
        return set()

    def end(self) -> None:
        """End it with its controllers; what it said last is shown."""
        super().end()
        self.wait_for_last_words()

    def wait_for_last_words(self) -> None:
        """Until all lines of one that is over were shown."""
        for reader in self._readers:
            reader.join(_LAST_WORDS_S)

    def _read(self, name: str, pipe: IO[bytes]) -> None:
        with pipe:
            for data in pipe:
                line = ConsoleLine(name, data.decode("utf-8", "replace").rstrip("\r\n"))
                self._lines.append(line)
                with suppress(OSError, ValueError):  # nobody looks any more: Webots goes on
                    self._show(line)
