"""The recordings that the plots are tested on, and what holds for tests of interactive figures."""

from __future__ import annotations

import pytest

from tests.plotting.conftest import record, rover

pytest.importorskip("bokeh", reason="the extra 'view' is not installed")

__all__ = ["record", "rover"]
