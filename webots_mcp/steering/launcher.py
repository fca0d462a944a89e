"""The Webots that a server has started: at most one, which ends with the server."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path

from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME
from webots_mcp.database.location import find_project
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.simulator.launch import WebotsLaunch
from webots_mcp.simulator.orders import WebotsLine
from webots_mcp.simulator.starting import Start
from webots_mcp.steering.trial_worker import TrialWorkers
from webots_mcp.store.policy import LAUNCH
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import permit


class Launcher:
    """Starts Webots for a recording.

    Attributes:
        launched: The Webots that was started last.
    """

    def __init__(self, recording: RecordingAccess) -> None:
        self.launched: WebotsLaunch | None = None
        self._recording = recording
        self._lock = threading.Lock()

    @property
    def running(self) -> WebotsLaunch | None:
        """The Webots that is still running, or None."""
        launched = self.launched
        return launched if launched is not None and not launched.webots.is_over else None

    def begin(self, start: Start) -> WebotsLaunch:
        """Start Webots.

        Raises:
            NotAllowedError: A rule of the project forbids it.
            CommandRefusedError: It already runs, it is not installed, or there is no display.
            DatabaseError: The database cannot be used.
        """
        with self._lock:
            if self.running is not None:
                raise CommandRefusedError(
                    f"The Webots that this server started is still running with "
                    f"{self.running.world.name}. webots_load_world opens another world in it, and "
                    "webots_quit ends it."
                )
            permit(self._recording, LAUNCH, {"world": str(start.world)}, create=True)
            self.launched = WebotsLaunch(self._recording, start, self._environment(), _ignore)
            return self.launched

    def stop(self) -> None:
        """End it."""
        with self._lock:
            if self.launched is not None:
                self.launched.webots.end()

    def _environment(self) -> dict[str, str]:
        """Return the variables by which its controllers record where this server reads."""
        recording = self._recording
        if recording.database != recording.data_dir / DATABASE_NAME:
            return {}
        return {DATA_DIR_VARIABLE: str(recording.data_dir)}


@dataclass(frozen=True)
class Companions:
    """What runs in the background of a server, until the server ends."""

    trials: TrialWorkers
    webots: Launcher

    def stop(self) -> None:
        """End all of them."""
        self.trials.stop()
        self.webots.stop()


def project_of(recording: RecordingAccess) -> Path:
    """Find the Webots project of a server: that of its data folder, else of its current folder.

    Raises:
        InvalidInputError: Neither folder is in a project.
    """
    project = find_project(recording.data_dir) or find_project(Path.cwd())
    if project is None:
        raise InvalidInputError(
            f"This server has no Webots project: neither its data folder {recording.data_dir} nor "
            "its current folder is in one. Start it with --data-dir PROJECT/mcp_data."
        )
    return project.resolve()


def _ignore(line: WebotsLine) -> None:
    """Do nothing with a line of Webots' output: `LaunchedWebots` keeps the newest ones."""
