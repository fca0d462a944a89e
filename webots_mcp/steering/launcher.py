"""The Webots that a server has started: one at most, which ends with the server."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, find_project
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.launch import Launch
from webots_mcp.steering.trial_worker import TrialWorkers
from webots_mcp.store.recording import Recording
from webots_mcp.webots.starting import Start
from webots_mcp.webots.stream import WebotsLine


class Launcher:
    """Starts Webots for a recording.

    Attributes:
        launched: The one that was started last.
    """

    def __init__(self, recording: Recording) -> None:
        self.launched: Launch | None = None
        self._recording = recording
        self._lock = threading.Lock()

    @property
    def running(self) -> Launch | None:
        """The one that runs."""
        launched = self.launched
        return launched if launched is not None and not launched.webots.is_over else None

    def begin(self, start: Start) -> Launch:
        """Start Webots.

        Raises:
            CommandRefusedError: It runs already, or there is none, or no display.
            DatabaseError: Nothing can be recorded.
        """
        with self._lock:
            if self.running is not None:
                raise CommandRefusedError(
                    f"the Webots that this server has started still runs {self.running.world.name}:"
                    " action=load opens another world in it, action=quit ends it"
                )
            self.launched = Launch(self._recording, start, self._environment(), _overhear)
            return self.launched

    def stop(self) -> None:
        """End it."""
        with self._lock:
            if self.launched is not None:
                self.launched.webots.end()

    def _environment(self) -> dict[str, str]:
        """What has its controllers record where this server reads."""
        recording = self._recording
        if recording.database != recording.data_dir / DATABASE_NAME:
            return {}
        return {DATA_DIR_VARIABLE: str(recording.data_dir)}


@dataclass(frozen=True)
class Companions:
    """What runs beside a server's answers, as long as the server does."""

    trials: TrialWorkers
    webots: Launcher

    def stop(self) -> None:
        """End all of them."""
        self.trials.stop()
        self.webots.stop()


def project_of(recording: Recording) -> Path:
    """The Webots project that a server is for: of its data folder, else of the current one.

    Raises:
        InvalidInputError: There is none.
    """
    project = find_project(recording.data_dir) or find_project(Path.cwd())
    if project is None:
        raise InvalidInputError(
            f"this server is for no Webots project: neither its data folder {recording.data_dir} "
            "nor its current folder is in one; start it with --data-dir PROJECT/mcp_data"
        )
    return project.resolve()


def _overhear(line: WebotsLine) -> None:
    """Its newest lines are kept by `LaunchedWebots`."""
