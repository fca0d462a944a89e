"""The recordings that the plots are tested on, and what holds for tests of interactive figures."""

from __future__ import annotations

from tests.plotting.conftest import record, rover

__all__ = ["record", "rover"]
