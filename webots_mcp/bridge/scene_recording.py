"""The built-in action that films the simulation: record_scene.

Webots makes the movie or the animation; the loop only asks for it, and polls what became of it. It
returns a generator, see `webots_mcp.bridge.control`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress, whole_number
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Clock, Simulation
from webots_mcp.contract import SCENE_FOLDER
from webots_mcp.database.files import make_folder
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_KINDS: Final = {"movie": ".mp4", "animation": ".html"}
_START_S: Final = 5.0  # of wall time until Webots says that it records
_SAVE_S: Final = 600.0  # of wall time until a movie is encoded
_POLL_S: Final = 0.05  # between two requests: each is answered by Webots' main thread
_LARGEST_PX: Final = 4096
_TAIL_BYTES: Final = 16


class _UnderWay(NamedTuple):
    """A recording that is under way.

    Attributes:
        path: Of its file, from the data folder on.
        from_s: Simulation time at which it began.
    """

    kind: str
    path: str
    from_s: float


class SceneRecording:
    """Begins and ends a movie or an animation of the scene; one is under way at most."""

    def __init__(
        self, simulation: Simulation, clock: Clock, journal: Journal, data_dir: Path
    ) -> None:
        self._simulation = simulation
        self._clock = clock
        self._journal = journal
        self._data_dir = data_dir
        self._current: _UnderWay | None = None

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {"record_scene": self.record_scene}

    def require_none(self, what: str) -> None:
        """Refuse what would end the recording without a file.

        Raises:
            CommandRefusedError: A recording is under way.
        """
        if self._current is not None:
            raise CommandRefusedError(
                f"{what} would discard the {self._current.kind} that is being recorded since "
                f"{self._current.from_s:.3f} s. Stop it first: webots_record_scene(action='stop')"
            )

    def close(self) -> None:
        """End a recording with the controller, so that Webots writes its file."""
        recording, self._current = self._current, None
        if recording is None or self._simulation.over:
            return
        self._stop(recording)
        self._journal.log(
            "warning", "bridge",
            f"the {recording.kind} was stopped because the controller ends; Webots writes it to "
            f"{self._data_dir / recording.path}",
        )  # fmt: skip

    def record_scene(self, command: ClaimedCommand) -> Progress:
        """Start or stop a recording.

        Raises:
            InvalidInputError: A parameter is out of bounds.
            CommandRefusedError: Webots cannot record now, or there is nothing to stop.
        """
        params = command.params
        kind = params.get("kind") or (self._current.kind if self._current else "movie")
        if kind not in _KINDS:
            raise InvalidInputError(f"kind must be movie or animation, not {kind!r:.80}")
        if params["do"] == "start":
            size = [
                whole_number(params, "width", 16, _LARGEST_PX, default=1280),
                whole_number(params, "height", 16, _LARGEST_PX, default=720),
                whole_number(params, "quality", 1, 100, default=90),
                whole_number(params, "speed", 1, 100, default=1),
            ]
            return self._start(command, str(kind), size, caption=params.get("caption") is True)
        if params["do"] != "stop":
            raise InvalidInputError(f"do must be start or stop, not {params['do']!r:.80}")
        return self._end(str(kind))

    # Start ----------------------------------------------------------------------------------------

    def _start(
        self, command: ClaimedCommand, kind: str, numbers: list[int], *, caption: bool
    ) -> Progress:
        if self._current is not None:
            raise CommandRefusedError(
                f"{_a(self._current.kind)} is being recorded since {self._current.from_s:.3f} s, "
                f"and one recording is possible at a time. Stop it first: "
                "webots_record_scene(action='stop')"
            )
        robot = self._simulation.robot
        if not robot.movieIsReady():
            raise CommandRefusedError(
                "Webots is recording or encoding a movie that this controller has not started. "
                "Wait until it is written, or stop it where it was started"
            )
        recording = _UnderWay(
            kind, f"{SCENE_FOLDER}/{kind}-{command.id:06d}{_KINDS[kind]}", self._clock.sim_time_s
        )
        file = self._data_dir / recording.path
        make_folder(file.parent)
        if kind == "animation":
            if not robot.animationStartRecording(str(file)):
                raise CommandRefusedError(
                    f"Webots could not begin the animation {file}. Its console has the reason; "
                    "it cannot record one while it streams the scene (--stream)"
                )
        else:
            width, height, quality, speed = numbers
            robot.movieStartRecording(str(file), width, height, 0, quality, speed, caption)
            yield from _until(lambda: not robot.movieIsReady(), _START_S, (
                f"Webots did not begin to record {file} within {_START_S:.0f} s. Its console has "
                "the reason; a movie needs a rendered main view, which --no-rendering does not "
                "give"
            ))  # fmt: skip
        self._current = recording
        self._journal.event("record_scene", {"do": "start", "kind": kind, "path": recording.path})
        return {"kind": kind, "path": recording.path, "from_s": recording.from_s}

    # Stop -----------------------------------------------------------------------------------------

    def _end(self, kind: str) -> Progress:
        recording = self._current
        if recording is None:
            raise CommandRefusedError(
                "nothing is being recorded: this controller has started no recording, or it was "
                "restarted since. Start one: webots_record_scene(action='start')"
            )
        if kind != recording.kind:
            raise InvalidInputError(
                f"{_a(recording.kind)} is being recorded, not {_a(kind).lower()}. Leave kind out"
            )
        self._current = None  # whatever comes of it
        to_s = self._clock.sim_time_s
        self._stop(recording)
        if recording.kind == "movie":
            yield from self._until_saved(recording)
        files = self._files(recording)
        facts = {"kind": recording.kind, "path": recording.path}
        self._journal.event("record_scene", {"do": "stop", **facts})
        length_s = round(to_s - recording.from_s, 6)
        went_back = {"note": "simulation time went back meanwhile"} if length_s < 0 else {}
        size = sum(file.stat().st_size for file in files)
        others = [file.name for file in files if file.name != Path(recording.path).name]
        return {
            **facts, "from_s": recording.from_s, "to_s": to_s, "size_bytes": size,
            **({"also": others} if others else {}), **went_back,
        }  # fmt: skip

    def _stop(self, recording: _UnderWay) -> None:
        robot = self._simulation.robot
        if recording.kind == "movie":
            robot.movieStopRecording()
        elif not robot.animationStopRecording():
            raise CommandRefusedError(
                f"Webots could not write the animation {self._data_dir / recording.path}. Its "
                "console has the reason"
            )

    def _until_saved(self, recording: _UnderWay) -> Generator[None]:
        """Wait until Webots has encoded a movie.

        Raises:
            CommandRefusedError: It has failed, or is not done in time.
        """
        robot, file = self._simulation.robot, self._data_dir / recording.path
        yield from _until(robot.movieIsReady, _SAVE_S, (
            f"Webots has not finished the movie {file} within {_SAVE_S:.0f} s. It may still be "
            "encoding; a dialog may be open (start it with --batch)"
        ))  # fmt: skip
        if robot.movieFailed():
            raise CommandRefusedError(
                f"Webots failed to make the movie {file}. Either nothing was rendered meanwhile "
                "(the simulation did not run, or Webots runs with --no-rendering), or the encoder "
                "failed (ffmpeg on Linux). Its console has the reason"
            )

    def _files(self, recording: _UnderWay) -> list[Path]:
        """Return the files of a recording.

        Raises:
            CommandRefusedError: They are missing or not complete.
        """
        file = self._data_dir / recording.path
        data = file.with_suffix(".json")
        if recording.kind == "animation" and data.is_file() and not _is_whole(data):
            raise CommandRefusedError(
                f"the animation {file} has no content, because nothing moved while it was "
                "recorded. Let the simulation run between start and stop"
            )
        files = [each for each in sorted(file.parent.glob(f"{file.stem}.*")) if each.is_file()]
        if file not in files or not file.stat().st_size:
            raise CommandRefusedError(
                f"Webots reported no failure, but wrote no {file}. Its console has the reason"
            )
        return files


def _is_whole(data: Path) -> bool:
    """Return whether the JSON of an animation is complete; it is not if nothing moved."""
    with data.open("rb") as file:
        file.seek(max(0, data.stat().st_size - _TAIL_BYTES))
        return file.read().rstrip().endswith(b"}")


def _until(condition: Callable[[], Any], timeout_s: float, otherwise: str) -> Generator[None]:
    """Yield until a condition holds, which is checked now and then.

    Raises:
        CommandRefusedError: It does not hold in time.
    """
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        checked_s = time.monotonic()
        if checked_s > deadline_s:
            raise CommandRefusedError(otherwise)
        while time.monotonic() - checked_s < _POLL_S:
            yield


def _a(kind: str) -> str:
    return f"{'An' if kind[0] in 'aeiou' else 'A'} {kind}"
