"""A Dask scheduler and its workers as processes of this machine, each ended by its pid."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from pathlib import Path

import psutil

from tests.waiting import wait_for

# Only workers need this package: the scheduler of a cluster lacks it.
_RUN = """
import sys
if "{0}" == "scheduler":
    sys.modules["webots_mcp"] = None
from distributed.cli.dask_{0} import main
main()
"""

_ADDRESS = re.compile(r"Scheduler at:\s+(tcp://\S+)")


class Process:
    """A program of Dask's, which prints to a file."""

    def __init__(self, folder: Path, program: str, *words: str) -> None:
        folder.mkdir(parents=True)
        self.folder = folder
        self._log = folder / "log.txt"
        line = [sys.executable, "-c", _RUN.format(program), "--no-dashboard", *words]
        # One death of a worker is an accident, two are the trial's fault.
        environment = {
            **os.environ,
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
        }
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                line, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                env=environment, cwd=folder,
            )  # fmt: skip

    def said(self, pattern: str | re.Pattern[str]) -> re.Match[str]:
        """What it prints, once it has."""

        def look() -> re.Match[str] | None:
            text = self._log.read_text("utf-8", "replace")
            assert self.process.poll() is None, text
            return re.search(pattern, text)

        return wait_for(look, patience_s=120.0)

    def end(self) -> None:
        """Hard, with what it has started."""
        with contextlib.suppress(psutil.NoSuchProcess):
            for each in psutil.Process(self.process.pid).children(recursive=True):
                with contextlib.suppress(psutil.NoSuchProcess):
                    each.kill()
        self.process.kill()
        self.process.wait()


class Worker(Process):
    """One that runs a simulator."""

    def __init__(self, folder: Path, address: str, *words: str) -> None:
        super().__init__(
            folder, "worker", address, "--no-nanny", "--nthreads", "1", "--host", "127.0.0.1",
            "--local-directory", str(folder), *words,
        )  # fmt: skip

    @property
    def trials(self) -> list[Path]:
        """The scratch folders of the trials that it runs."""
        scratch = self.folder / "dask-scratch-space"
        found: list[Path] = []
        for worker in filter(Path.is_dir, scratch.glob("worker-*")):
            with contextlib.suppress(FileNotFoundError):  # it ends just now
                found += [each for each in worker.iterdir() if each.name.startswith("trial-")]
        return found

    @property
    def recording(self) -> Path | None:
        """Of the trial that it runs, once there is one."""
        files = (each / "data" / "webots.db" for each in self.trials)
        return next((each for each in files if each.exists()), None)

    @property
    def children(self) -> list[psutil.Process]:
        """What it has started, which is to end with it."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def kill(self) -> list[psutil.Process]:
        """By SIGKILL; returns what it had started."""
        children = self.children
        self.process.kill()
        self.process.wait()
        return children


class Cluster:
    """A scheduler, and workers as a test needs them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started = 0
        self.scheduler = Process(
            folder / "scheduler", "scheduler", "--host", "127.0.0.1", "--port", "0"
        )
        self.address = self.scheduler.said(_ADDRESS)[1]
        self._workers: list[Worker] = []

    @property
    def workers(self) -> list[Worker]:
        """Those that live."""
        return [each for each in self._workers if each.process.poll() is None]

    def start(self, number: int, *words: str) -> list[Worker]:
        """Have so many workers with a simulator."""
        for _ in range(number - len(self.workers)):
            self._started += 1
            options = words or ("--resources", "simulator=1")
            self._workers.append(
                Worker(self._folder / f"worker{self._started}", self.address, *options)
            )
        for each in self.workers:
            each.said("Registered to:")
        return self.workers

    def end(self) -> None:
        for each in (*self._workers, self.scheduler):
            each.end()
