"""Shipping on and on while a robot records, also where the pool or the recording goes away."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NoReturn

from webots_mcp.contract import Database
from webots_mcp.errors import (
    NoDatabaseError,
    PoolBusyError,
    PoolError,
    PoolUnavailableError,
)
from webots_mcp.plugins.pool.report import Report
from webots_mcp.plugins.pool.shipping import Order, ReplacedError, Shipper, shipper
from webots_mcp.store.recording import name_of

THOROUGH_S: Final = 30.0  # between two looks at all of what may change, and not only the newest
_FIRST_WAIT_S: Final = 1.0
_LONGEST_WAIT_S: Final = 60.0

Say = Callable[[str], None]


def follow(order: Order, report: Report, say: Say, pause_s: float) -> None:
    """Ship what is there and what comes, until a KeyboardInterrupt.

    A pool that is away is tried again, each time after a longer wait; a recording that is not there
    yet is waited for.

    Args:
        order: What.
        report: Grows while it goes on.
        say: Told in a sentence when the pool is away, and when it is back.
        pause_s: Between two looks at the recording.

    Raises:
        PoolError: The pool will not be better by itself.
        DatabaseError: The recording cannot be read.
    """
    patience = _Patience(say, pause_s)
    while True:
        time.sleep(_go_on_until_it_fails(order, report, say, pause_s, patience))


def _go_on_until_it_fails(
    order: Order, report: Report, say: Say, pause_s: float, patience: _Patience
) -> float:
    """Ship as long as recording and pool are there; returns how long to wait then."""
    try:
        with shipper(order, report) as connected:
            patience.connected(connected.address)
            _go_on(connected, pause_s)
    except ReplacedError as error:
        say(f"{error}: that one is shipped from here on")
        return 0.0
    except NoDatabaseError:
        return patience.wait_for(order.recording.database)
    except (PoolBusyError, PoolUnavailableError) as error:
        return patience.wait_after(error)


class _Patience:
    """How long to wait before the next attempt, and what is said of it."""

    def __init__(self, say: Say, pause_s: float) -> None:
        self._say = say
        self._pause_s = pause_s
        self._away_s = 0.0
        self._was_there = False
        self._has_told = False

    def connected(self, address: str) -> None:
        """The recording and the pool are there."""
        if self._away_s:
            self._say(f"the pool {address} is there again")
        self._away_s, self._was_there, self._has_told = 0.0, True, False

    def wait_for(self, database: Database) -> float:
        """In seconds, where no recording is."""
        there = f"nothing is recorded at {name_of(database)} now"
        self._tell_once(f"{there}: it is shipped as soon as it is there")
        return self._pause_s

    def wait_after(self, error: PoolError) -> float:
        """In seconds; what would not be better after it is raised again."""
        if isinstance(error, PoolBusyError):
            if not self._was_there:
                raise error
            self._tell_once(f"{error}; waiting until it ends")
            return _FIRST_WAIT_S  # it may be our last connection, of which a server learns late
        self._away_s = min(max(2 * self._away_s, _FIRST_WAIT_S), _LONGEST_WAIT_S)
        self._say(f"{error}; trying again in {self._away_s:g} s, nothing is lost meanwhile")
        return self._away_s

    def _tell_once(self, text: str) -> None:
        if not self._has_told:
            self._say(text)
        self._has_told = True


def _go_on(connected: Shipper, pause_s: float) -> NoReturn:
    next_s = 0.0
    while True:
        is_thorough = time.monotonic() >= next_s
        if is_thorough:
            next_s = time.monotonic() + THOROUGH_S
        if connected.round(thorough=is_thorough):
            time.sleep(pause_s)
