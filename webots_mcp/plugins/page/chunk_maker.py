"""The thread that puts rows into chunks while the page is served.

Without chunks a long run could be drawn in part only, and there may be no MCP server to make them.
"""

from __future__ import annotations

import threading
from typing import Final

from webots_mcp.errors import WebotsMCPError
from webots_mcp.store.chunk_making import make_missing_chunks
from webots_mcp.store.recording import RecordingAccess

_PERIOD_S: Final = 1.0


class ChunkMaker(threading.Thread):
    """Checks once a second whether rows can be put into chunks.

    Attributes:
        says: Its progress, or why it stopped; "" if nothing is left.
        rounds: How often it has put all rows into chunks.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        super().__init__(name="webots-mcp page", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self.says = ""
        self.rounds = 0

    def run(self) -> None:
        """Make chunks until stopped."""
        while not self._ending.is_set():
            self.make_chunks()
            self._ending.wait(_PERIOD_S)

    def make_chunks(self) -> None:
        """Put the rows that are there into chunks."""
        worked = False

        def note(done: int, of: int) -> None:
            nonlocal worked
            worked = True
            self.says = f"making chunks of what was recorded: {100 * done // max(of, 1)} %"

        try:
            self.says = make_missing_chunks(self._recording, note, called_off=self._ending.is_set)
        except WebotsMCPError:  # The tabs report it.
            self.says = ""
        self.rounds += worked

    def stop(self) -> None:
        """Stop the thread, and wait for it for at most 2 s."""
        self._ending.set()
        self.join(timeout=2)
