"""Records what signals mean, as declared by the controller's code and described by its devices.

Each declaration is written when it is made, and again into a new database.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from typing import Any, Final

from webots_mcp.bridge.recorder import Recorder
from webots_mcp.database.waiting_file import Kind, Values
from webots_mcp.signals.meaning import DeclaredMeaning

MOST_DECLARED: Final = 2000  # as many as a robot may have signals
ROWS_AT_ONCE: Final = 100  # of devices, in one statement


class SignalMeanings:
    """Records what signals mean."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._declared: dict[str, DeclaredMeaning] = {}
        self._of_devices: list[tuple[Any, ...]] = []
        recorder.new_database_entries.append(self._entries_for_new_database)

    def declare(self, declared: DeclaredMeaning) -> None:
        """Record what the controller declares about a signal, in place of an earlier declaration.

        Raises:
            ValueError: If there are 2,000 declarations already.
        """
        if self._declared.get(declared.name) == declared:
            return
        if declared.name not in self._declared and len(self._declared) >= MOST_DECLARED:
            raise ValueError(
                f"signal {declared.name!r} would be number {MOST_DECLARED + 1}, and a controller "
                f"may describe {MOST_DECLARED}; describe several at once with '*'"
            )
        self._declared[declared.name] = declared
        self._recorder.record("meaning", None, _values_of(declared))

    def record_devices(self, known: Sequence[tuple[DeclaredMeaning, str]]) -> None:
        """Record the meaning of the signals that `auto_publish` makes of devices.

        Args:
            known: The meaning of each signal, and the device in words.
        """
        self._of_devices = [(*said, why) for said, why in known]
        for values in self._rows_of_devices():
            self._recorder.record("device meanings", None, values)

    def _rows_of_devices(self) -> Iterable[dict[str, Any]]:
        for start in range(0, len(self._of_devices), ROWS_AT_ONCE):
            rows = self._of_devices[start : start + ROWS_AT_ONCE]
            yield {"rows": json.dumps(rows, ensure_ascii=False), "now": time.time()}

    def _entries_for_new_database(self) -> Iterable[tuple[Kind, bool, Values]]:
        """Yield the entries for a new database: kind, whether it belongs to the run, values."""
        for declared in tuple(self._declared.values()):  # the maintainer's thread may call this
            yield "meaning", False, _values_of(declared)
        for values in self._rows_of_devices():
            yield "device meanings", False, values


def _values_of(declared: DeclaredMeaning) -> dict[str, Any]:
    return {**declared._asdict(), "now": time.time()}
