"""Sums up the reward of each run, as an `episode` event at its end.

Learners publish a `reward` in each step. The throttle records only some steps, so that the sum
cannot be computed from the rows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from numbers import Real
from typing import Any, Final

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.contract import EPISODE_EVENT

_REWARD: Final = "reward"
_FLAGS: Final = ("terminated", "truncated", "success", "is_success")  # as Gymnasium names them
_AS_SUCCESS: Final = "is_success"  # what Stable-Baselines3 calls it


class Episode:
    """The reward of the current run, summed up over each published state, recorded or not."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._reward = 0.0
        self._count = 0
        self._flags: dict[str, bool] = {}

    def add(self, state: Mapping[Any, Any]) -> None:
        """Add the reward of a published state, if it has one."""
        if state.__class__ is not dict or _REWARD not in state:
            return
        reward = state[_REWARD]
        if not isinstance(reward, Real):  # numpy's numbers are registered as such
            return
        try:
            value = float(reward)
        except (OverflowError, TypeError, ValueError):  # an integer of 400 digits, a hostile number
            return
        if not math.isfinite(value):
            return
        self._reward += value
        self._count += 1
        for name in _FLAGS:
            flag = state.get(name)
            if flag is not None and flag.__class__ in (bool, int):
                self._flags["success" if name == _AS_SUCCESS else name] = bool(flag)

    def end(self, sim_time_s: float) -> None:
        """Record what the run that ends has earned, and begin anew."""
        if self._count:
            data = {"reward": self._reward, "count": self._count, **self._flags}
            row = (sim_time_s, time.time(), EPISODE_EVENT, None, encode(data).text)
            self._recorder.record("event", self._recorder.run, row)
        self._reward, self._count, self._flags = 0.0, 0, {}
