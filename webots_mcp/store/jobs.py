"""Jobs that one process at a time does in a recording, as long as it holds their lease."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Final

from webots_mcp.errors import DatabaseError, LeaseLostError
from webots_mcp.leases import Lease, still_held
from webots_mcp.store.recording import Recording

_RENEW_EVERY_S: Final = 3.0

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """What this process does as long as it holds the lease.

    Attributes:
        recording: In which the lease is.
        lease: Which this process has taken.
    """

    recording: Recording
    lease: Lease

    @contextmanager
    def writer(self) -> Generator[sqlite3.Connection]:
        """A connection in a transaction, for what only the holder may write.

        Raises:
            LeaseLostError: Another process has the lease; nothing is written.
        """
        with self.recording.writer() as connection, still_held(connection, self.lease):
            yield connection

    def require_held(self) -> None:
        """See that it is still this process that does it.

        Raises:
            LeaseLostError: Another one does.
        """
        with self.writer():
            pass

    @contextmanager
    def renewed(self) -> Generator[None]:
        """While this lasts, the lease does not run out."""
        over = threading.Event()
        thread = threading.Thread(target=self._renew, args=(over,), daemon=True)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def _renew(self, over: threading.Event) -> None:
        while not over.wait(_RENEW_EVERY_S):
            with suppress(LeaseLostError):  # the worker finds out when it writes
                self._renew_now()

    def _renew_now(self) -> None:
        try:
            self.require_held()
        except DatabaseError as error:  # there is time to try again
            _log.warning("%s is not renewed: %s", self.lease.name, error)
