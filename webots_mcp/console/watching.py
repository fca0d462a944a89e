"""Following the consoles of all Webots of a recording, those that start later as well."""

from __future__ import annotations

import threading
from typing import Final

from webots_mcp.console.following import ConsoleFollower
from webots_mcp.console.ownership import own_webots
from webots_mcp.errors import warn
from webots_mcp.store.recording import Recording

_FIRST_LOOK_S: Final = 1.0  # a server that has just started has answers to give
_LOOK_EVERY_S: Final = 5.0


class ConsoleWatch(threading.Thread):
    """A daemon thread that looks for Webots of the recording, and follows each of them.

    Args:
        recording: Where the lines are to be recorded.
    """

    def __init__(self, recording: Recording) -> None:
        super().__init__(name="webots-mcp consoles", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self._followers: dict[tuple[int, int], ConsoleFollower] = {}
        self._warned_of = ""

    def run(self) -> None:
        """Look until stopped; whatever goes wrong ends a look, never the thread."""
        pause_s = _FIRST_LOOK_S
        while not self._ending.wait(pause_s):
            pause_s = _LOOK_EVERY_S
            try:
                self.look()
            except Exception as error:  # noqa: BLE001  (it is told)
                if str(error) != self._warned_of:
                    self._warned_of = str(error)
                    warn(f"no console of Webots is followed: {error}")

    def look(self) -> None:
        """Follow what is not followed yet.

        Raises:
            DatabaseError: The recording cannot be read.
        """
        over = [key for key, follower in self._followers.items() if not follower.is_alive()]
        for key in over:
            del self._followers[key]
        for instance in own_webots(self._recording):
            key = (instance.pid, instance.port)
            if instance.is_listening and key not in self._followers:
                self._followers[key] = ConsoleFollower(instance, self._recording)
                self._followers[key].start()

    def stop(self) -> None:
        """Let others follow."""
        self._ending.set()
        if self.is_alive():
            self.join(timeout=2)
        for follower in self._followers.values():
            follower.let_go()
        for follower in self._followers.values():
            follower.stop()
