"""The lease of a recording in a pool: one shipper at a time, on whatever host."""

from __future__ import annotations

import json
import os
import time
from dataclasses import asdict, dataclass
from typing import Any, Final

from webots_mcp.contract import host_name
from webots_mcp.errors import PoolBusyError
from webots_mcp.liveness import process_identity
from webots_mcp.plugins.pool.parquet.storage import Storage

LEASE_S: Final = 60.0
# One that ends later was taken before a clock was set back. It is not one lease from now: it may
# be renewed after this host looked at its clock, and the clock of the other host may be ahead.
_LATEST_S: Final = 2 * LEASE_S
_RENEW_AFTER_S: Final = 15.0


@dataclass(frozen=True)
class _Holder:
    """Who ships, and until when nobody else may."""

    host: str
    pid: int
    process: str | None
    token: str
    until_wall_time_s: float

    def encoded(self) -> bytes:
        return json.dumps(asdict(self)).encode()

    def is_gone(self, now_s: float) -> bool:
        """Whether another may take over: this host knows that the process ended, or it is silent.

        A shipper of this host that waits for long between two looks is not gone.
        """
        if self.host == host_name() and self.process is not None:
            return process_identity(self.pid) != self.process
        return not now_s < self.until_wall_time_s <= now_s + _LATEST_S


class Lease:
    """Held from `take` to `give_back`, as long as it is renewed."""

    def __init__(self, storage: Storage, path: str) -> None:
        self._storage = storage
        self._path = path
        self._token = os.urandom(8).hex()
        self._until_s = 0.0

    def take(self) -> None:
        """Become the one who ships.

        Raises:
            PoolBusyError: Another does.
        """
        now_s = time.time()
        if self._storage.create(self._path, self._mine(now_s)):
            return
        holder = self._holder()
        if holder is not None and not holder.is_gone(now_s):
            raise PoolBusyError(self._taken(holder))
        self._storage.place(self._path, self._mine(now_s))
        self.require_mine()

    def renew(self) -> None:
        """Before each thing that only the holder may do: see that this one still is.

        Raises:
            PoolBusyError: It had not renewed its lease for too long, and another has it.
        """
        now_s = time.time()
        if LEASE_S - _RENEW_AFTER_S < self._until_s - now_s <= LEASE_S:
            return
        self.require_mine()
        self._storage.place(self._path, self._mine(now_s))

    def give_back(self) -> None:
        """Let others take it at once."""
        holder = self._holder()
        if holder is not None and holder.token == self._token:
            self._storage.remove(self._path)

    def require_mine(self) -> None:
        """See in the pool that nobody else has taken it.

        Raises:
            PoolBusyError: Another has.
        """
        holder = self._holder()
        if holder is None or holder.token != self._token:
            raise PoolBusyError(self._taken(holder))

    def _mine(self, now_s: float) -> bytes:
        self._until_s = now_s + LEASE_S
        pid = os.getpid()
        mine = _Holder(host_name(), pid, process_identity(pid), self._token, self._until_s)
        return mine.encoded()

    def _holder(self) -> _Holder | None:
        content = self._storage.read(self._path)
        if content is None:
            return None
        try:
            told: dict[str, Any] = json.loads(content)
            return _Holder(**told)
        except (ValueError, TypeError):  # nobody's: it is taken over
            return None

    def _taken(self, holder: _Holder | None) -> str:
        by = f"process {holder.pid} on {holder.host}" if holder else "another process"
        return (
            f"{by} ships this recording to {self._storage.address}: end it, or wait "
            f"{LEASE_S:g} s after it is gone"
        )
