"""Where the controller's own variables are read: at hits, errors and hangs, and on request.

The modules that read them (`webots_mcp.bridge.inspection`) are imported when they are first needed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final

from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.recorder import this_call
from webots_mcp.bridge.simulation import Clock
from webots_mcp.errors import InvalidInputError

if TYPE_CHECKING:
    from webots_mcp.bridge.inspection.inspector import Inspector
    from webots_mcp.bridge.inspection.watches import Watches


_STARTED_S: Final = time.time()  # the bridge is imported when the controller starts


class ControllerVariables:
    """Records and shows the variables of one controller; nothing raises into its loop.

    Args:
        data_dir: The recording's folder, whose project may name secrets.

    Attributes:
        watches: The watched variables; None while none was ever watched.
    """

    def __init__(self, clock: Clock, journal: Journal, errors: ErrorReport, data_dir: Path) -> None:
        self._clock = clock
        self._journal = journal
        self._errors = errors
        self._data_dir = data_dir
        self._inspector: Inspector | None = None
        self.watches: Watches | None = None

    # -- recording -----------------------------------------------------------------------------

    def record(self, cause: str, name: str, key: object) -> None:
        """Record the variables of the code that called the bridge.

        Args:
            cause: `breakpoint`, `violation` or `error`.
            name: What happened.
            key: Of what at most 20 inspections are recorded in a run.
        """
        try:
            self.inspector.record(cause, name, key, this_call(1))
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("inspection", error)

    def prepare(self) -> None:
        """Import what reads variables, so that the first hit of a breakpoint need not."""
        try:
            self.inspector.prepare()
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("inspection", error)

    def record_thread(self, name: str, thread: int) -> None:
        """Record the variables of a thread that hangs."""
        try:
            frame = sys._current_frames().get(thread)  # pyright: ignore[reportPrivateUsage]
            self.inspector.record("hang", name, "hang", frame)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("inspection", error)

    def record_uncaught(self, error: BaseException, name: str) -> None:
        """Record the variables where an exception was raised that ends the controller."""
        try:
            self.inspector.record_error(error, name)
        except Exception as failure:  # noqa: BLE001  (the robot comes first)
            self._errors.failed("inspection", failure)

    # -- answering -----------------------------------------------------------------------------

    def show(self, path: object, frame: FrameType | None) -> dict[str, object]:
        """Return the frames of the loop with their variables, or the value at a path.

        Raises:
            InvalidInputError: The path is invalid, or inspection is switched off.
            CommandRefusedError: The path ends before its end.
        """
        return self.inspector.show(path, frame)

    def watch(self, params: Mapping[str, Any], frame: FrameType | None) -> dict[str, object]:
        """Begin or end to watch a path; answer with its value now.

        Raises:
            InvalidInputError: A parameter is invalid, or inspection is switched off.
            CommandRefusedError: The path cannot be followed, or too many are watched.
        """
        from webots_mcp.bridge.inspection.watches import MOST_EVERY, Watches
        from webots_mcp.database.variable_paths import parse_path

        path = parse_path(params.get("path"), self.inspector.secrets())
        stop, every = (
            default if params.get(name) is None else params[name]
            for name, default in (("stop", False), ("every", 1))
        )
        if type(stop) is not bool:
            raise InvalidInputError(f"stop must be true or false, not {stop!r:.80}")
        if type(every) is not int or not 1 <= every <= MOST_EVERY:
            raise InvalidInputError(
                f"every must be a whole number from 1 to {MOST_EVERY}, not {every!r:.80}"
            )
        watches = self.watches = self.watches or Watches(self._journal)
        if stop:
            watches.remove(path)
            return {"stopped": path.signal, "watched": watches.signals}
        shown = self.inspector.signal(path, frame)
        watches.add(path, every)
        return {"signal": path.signal, **shown, "watched": watches.signals}

    @property
    def inspector(self) -> Inspector:
        """What reads the frames."""
        if self._inspector is None:
            from webots_mcp.bridge.inspection.inspector import Inspector

            self._inspector = Inspector(
                self._clock, self._journal, self._errors, self._data_dir, _STARTED_S
            )
        return self._inspector
