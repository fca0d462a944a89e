"""Sums up the reward of each run, as an `episode` event at its end.

Learners publish a `reward` in each step. The throttle records only some steps, so that the sum
cannot be computed from the rows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any, Final, cast

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.contract import EPISODE_EVENT

_REWARD: Final = "reward"
_FLAGS: Final = ("terminated", "truncated", "success", "is_success")  # as Gymnasium names them
_AS_SUCCESS: Final = "is_success"  # what Stable-Baselines3 calls it
_DICT: Any = dict  # by its own functions a state of a class of the user's own is read


class Episode:
    """The reward of the current run, summed up over each published state, recorded or not."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._reward = 0.0
        self._count = 0  # states since the first with a reward, of which some have none
        self._missing = 0
        self._flags: dict[str, bool] = {}

    def add(self, state: Mapping[Any, Any]) -> None:
        """Add the reward of a published state, if it has one."""
        if not isinstance(state, dict):
            return
        values = cast("dict[str, object]", state)
        if not self._count and not _DICT.__contains__(values, _REWARD):
            return
        value = _number(_DICT.get(values, _REWARD))
        if value is None:
            self._missing += 1
        else:
            self._reward += value
        self._count += 1
        for name in _FLAGS:
            flag = _number(_DICT.get(values, name))
            if flag is not None:
                self._flags["success" if name == _AS_SUCCESS else name] = flag != 0

    def end(self, sim_time_s: float) -> None:
        """Record what the run that ends has earned, and begin anew."""
        if self._count > self._missing:
            data: dict[str, Any] = {"reward": self._reward, "count": self._count - self._missing}
            if self._missing:
                data["missing"] = self._missing
            data |= self._flags
            row = (sim_time_s, time.time(), EPISODE_EVENT, None, encode(data).text)
            self._recorder.record("event", self._recorder.run, row)
        self._reward, self._count, self._missing, self._flags = 0.0, 0, 0, {}


def _number(value: object) -> float | None:
    """Return a number as a float, as numpy's scalars and decimals too; None for anything else."""
    if value.__class__ is float or value.__class__ is bool:
        number = float(cast("float", value))
        return number if math.isfinite(number) else None
    if value is None or isinstance(value, (str, bytes)) or not hasattr(value, "__float__"):
        return None
    try:
        number = float(cast("Any", value)) if getattr(value, "ndim", 0) == 0 else math.nan
    except Exception:  # noqa: BLE001  (a number of the user's own: its state is recorded anyway)
        return None
    return number if math.isfinite(number) else None
