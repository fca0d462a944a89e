"""Hands the trials of a set out to a Dask cluster, in a thread of the server."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from webots_mcp.errors import CommandRefusedError, LeaseLostError, WebotsMCPError
from webots_mcp.plugins.cluster.dask_cluster import cluster
from webots_mcp.steering.trial_plan import WorldPlan
from webots_mcp.steering.trial_run import SetRun, StoppedError, run_taken_up, taken_up
from webots_mcp.store.recording import Recording
from webots_mcp.store.trials import Result, Trial

ALLOWED_VARIABLE: Final = "DASK_SCHEDULER_ADDRESS"  # Dask's own name for the one to use
_END_PATIENCE_S: Final = 5.0

_log = logging.getLogger(__name__)


class ClusterWorker(threading.Thread):
    """Connected with a scheduler from the start, so that a set is begun only where it can be run.

    Args:
        recording: Takes in what the trials record.
        scheduler: Its address.
        plan: Of the trials.
        is_stand_in: They run on the stand-in, not in Webots.

    Raises:
        CommandRefusedError: Who started the server allows no such scheduler, or as `cluster`.
        InvalidInputError: As `cluster`.
    """

    def __init__(
        self, recording: Recording, scheduler: str, plan: WorldPlan, *, is_stand_in: bool
    ) -> None:
        super().__init__(name=f"trials on {scheduler}", daemon=True)
        _require_allowed(scheduler)
        self._stopping = threading.Event()
        self.set_id = 0
        self._open = ExitStack()
        simulators = self._open.enter_context(cluster(scheduler, plan, is_stand_in=is_stand_in))
        self._set_run = SetRun(recording, plan, simulators, self._stopping)

    def begin(self, enter: Callable[[], int]) -> int:
        """Work on a set; returns its id, as `enter` gives it.

        Raises:
            CommandRefusedError: Another process does.
        """
        try:
            self.set_id = enter()
            self._set_run = taken_up(self._set_run, self.set_id)
        except BaseException:
            self._open.close()
            raise
        self.start()
        return self.set_id

    def stop(self) -> None:
        """The server ends: leave the set as it is."""
        self._stopping.set()
        self.join(_END_PATIENCE_S)

    def run(self) -> None:
        """Run what is left of the set; why it does not go on is noted in it."""
        with self._open:
            try:
                run_taken_up(self._set_run, self.set_id, _tell_nobody)
            except StoppedError:
                pass
            except LeaseLostError as error:
                _log.warning("%s", error)
            except WebotsMCPError as error:
                _log.info("%s", error)


def _tell_nobody(trial: Trial, result: Result) -> None:
    """Whoever asks reads the recording."""


def _require_allowed(scheduler: str) -> None:
    """Refuse a scheduler that only the model names: who answers there could run code here.

    Raises:
        CommandRefusedError: It is not the one that the server's environment names.
    """
    allowed = os.environ.get(ALLOWED_VARIABLE)
    if scheduler != allowed:
        which = f"only {allowed!r} is" if allowed else "none is"
        raise CommandRefusedError(
            f"scheduler {scheduler!r} is not allowed, {which}: who starts the server names it in "
            f"{ALLOWED_VARIABLE}, since a scheduler can run code here"
        )
