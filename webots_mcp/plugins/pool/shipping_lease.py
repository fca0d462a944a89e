"""The lease of a recording in a pool of files: one process ships a recording at a time."""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass
from typing import Final

from webots_mcp.contract import host_name
from webots_mcp.database.processes import process_identity
from webots_mcp.errors import (
    PoolBusyError,
)
from webots_mcp.plugins.pool.parquet_files import folder_of
from webots_mcp.plugins.pool.storage import Storage

LEASE: Final = "_lease"
LEASE_S: Final = 60.0
# A lease that ends later than this was taken before a clock was set back. The limit is more than
# one lease, because the holder may renew it meanwhile and its clock may be ahead.
_LATEST_S: Final = 2 * LEASE_S
_RENEW_AFTER_S: Final = 15.0


@dataclass(frozen=True)
class _Holder:
    """The process that ships, and the end of its lease."""

    host: str
    pid: int
    process: str | None
    token: str
    until_wall_time_s: float

    def is_gone(self, now_s: float) -> bool:
        """Return whether the holder has ended, so that another process can take over.

        A process of this host counts as running however long ago it renewed its lease.
        """
        if self.host == host_name() and self.process is not None:
            return process_identity(self.pid) != self.process
        return not now_s < self.until_wall_time_s <= now_s + _LATEST_S


class ShippingLease:
    """The lease of a recording, held from `take` to `give_back` as long as it is renewed."""

    def __init__(self, storage: Storage, recording_uuid: str) -> None:
        self._storage = storage
        self._path = f"{folder_of(recording_uuid)}/{LEASE}"
        self._token = os.urandom(8).hex()
        self._until_s = 0.0

    def take(self) -> None:
        """Become the only shipper of the recording.

        Raises:
            PoolBusyError: Another process ships it.
        """
        now_s = time.time()
        if self._storage.create(self._path, self._mine(now_s)):
            return
        holder = self._holder()
        if holder is not None and not holder.is_gone(now_s):
            raise self._taken(holder)
        self._storage.place(self._path, self._mine(now_s))
        self.require_mine()

    def renew(self) -> None:
        """Renew the lease if it ends soon. Called before each write.

        Raises:
            PoolBusyError: The lease was not renewed for too long, and another process took it.
        """
        now_s = time.time()
        if LEASE_S - _RENEW_AFTER_S < self._until_s - now_s <= LEASE_S:
            return
        self.require_mine()
        self._storage.place(self._path, self._mine(now_s))

    def give_back(self) -> None:
        """End the lease, so that others can take it at once."""
        holder = self._holder()
        if holder is not None and holder.token == self._token:
            self._storage.remove(self._path)

    def require_mine(self) -> None:
        """Check in the pool that no other process has taken the lease.

        Raises:
            PoolBusyError: Another process has.
        """
        holder = self._holder()
        if holder is None or holder.token != self._token:
            raise self._taken(holder)

    def _mine(self, now_s: float) -> bytes:
        self._until_s, pid = now_s + LEASE_S, os.getpid()
        mine = _Holder(host_name(), pid, process_identity(pid), self._token, self._until_s)
        return json.dumps(asdict(mine)).encode()

    def _holder(self) -> _Holder | None:
        try:
            return _Holder(**json.loads(self._storage.read(self._path) or b""))
        except (ValueError, TypeError):  # Damaged: it can be taken over.
            return None

    def _taken(self, holder: _Holder | None) -> PoolBusyError:
        by = f"process {holder.pid} on {holder.host}" if holder else "another process"
        return PoolBusyError(
            f"{by} ships this recording to {self._storage.address}: end it, or wait "
            f"{LEASE_S:g} s after it is gone"
        )
