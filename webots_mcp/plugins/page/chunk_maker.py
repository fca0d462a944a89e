"""Making chunks while the page is served, where no server does: what is long is drawn whole."""

from __future__ import annotations

import threading
from typing import Final

from webots_mcp.errors import WebotsMCPError
from webots_mcp.store.chunk_making import make_missing_chunks
from webots_mcp.store.recording import Recording

_PERIOD_S: Final = 1.0


class ChunkMaker(threading.Thread):
    """Looks once a second whether there is something to put into chunks.

    Attributes:
        says: How far it has come, or why it does not go on; "" where nothing is left.
        rounds: How often it put all that there was into chunks.
    """

    def __init__(self, recording: Recording) -> None:
        super().__init__(name="webots-mcp page", daemon=True)
        self._recording = recording
        self._ending = threading.Event()
        self.says = ""
        self.rounds = 0

    def run(self) -> None:
        """Look until stopped."""
        while not self._ending.is_set():
            self.look()
            self._ending.wait(_PERIOD_S)

    def look(self) -> None:
        """Put what there is into chunks."""
        worked = False

        def note(done: int, of: int) -> None:
            nonlocal worked
            worked = True
            self.says = f"making chunks of what was recorded: {100 * done // max(of, 1)} %"

        try:
            self.says = make_missing_chunks(self._recording, note, called_off=self._ending.is_set)
        except WebotsMCPError:  # the tabs say what it is
            self.says = ""
        self.rounds += worked

    def stop(self) -> None:
        """End it within an instant."""
        self._ending.set()
        self.join(timeout=2)
