"""Movies and animations of the arena, as a Supervisor asks for them.

A movie is an MP4 file of JPEG pictures from above. An animation is Webots' JSON of what moved, and
a page that draws it from above without a network.
"""

from __future__ import annotations

import io
import json
import os
import struct
import tempfile
import weakref
from collections.abc import Callable, Sequence
from enum import IntEnum
from pathlib import Path
from typing import IO, Any, Final

from webots_mcp.standin.arena import Arena, Body
from webots_mcp.standin.geometry import UprightBox
from webots_mcp.standin.view_pictures import Label, draw_view
from webots_mcp.standin.world import World

_FRAME_MS: Final = 40.0  # of movies and animations: 25 a second, as Webots aims at
_PAGE: Final = Path(__file__).parent / "data" / "animation.html"


class MovieStatus(IntEnum):
    """What became of a movie; the numbers are those of Webots' `WB_SUPERVISOR_MOVIE_...`."""

    READY = 0
    RECORDING = 1
    SAVING = 2
    WRITE_ERROR = 3
    ENCODING_ERROR = 4
    SIMULATION_ERROR = 5


class SceneRecorder:
    """Records one movie and one animation at a time."""

    def __init__(self, world: World, arena: Arena, log: Callable[[str], None]) -> None:
        self._world, self._arena, self._log = world, arena, log
        self._status = MovieStatus.READY
        self._movie: _Movie | None = None
        self._animation: _Animation | None = None

    def note_step(self, time_ms: float, labels: Sequence[Label]) -> None:
        """Record the step that was made, where a picture or a pose is due."""
        if self._movie is not None and self._status is MovieStatus.RECORDING:
            try:
                self._movie.note(time_ms, self._arena, labels)
            except (OSError, ImportError) as error:
                self._fail(MovieStatus.WRITE_ERROR, error)
        if self._animation is not None:
            self._animation.note(time_ms)

    # Movies ---------------------------------------------------------------------------------------

    def start_movie(self, path: Path, size: tuple[int, int], quality: int) -> None:
        """Film from the next step on."""
        self._movie = _Movie(path, size, quality)
        self._status = MovieStatus.RECORDING

    def stop_movie(self) -> None:
        """End the film; it is written once somebody has asked for the status."""
        if self._movie is None or self._status is not MovieStatus.RECORDING:
            return
        self._status = MovieStatus.SAVING
        if not self._movie.sizes:
            self._movie, self._status = None, MovieStatus.SIMULATION_ERROR
            self._log("WARNING: Nothing was recorded because the simulation didn't run.")

    def movie_status(self) -> MovieStatus:
        """Return what became of the movie; one that is being saved is saved after that."""
        status = self._status
        if status is MovieStatus.SAVING and self._movie is not None:
            try:
                self._movie.save()
                self._movie, self._status = None, MovieStatus.READY
            except OSError as error:
                self._fail(MovieStatus.ENCODING_ERROR, error)
        return status

    def _fail(self, status: MovieStatus, error: Exception) -> None:
        self._movie, self._status = None, status
        self._log(f"ERROR: Video generation failed: {error}")

    # Animations -----------------------------------------------------------------------------------

    def start_animation(self, path: Path) -> bool:
        """Record poses from the next step on; False if the file cannot be written."""
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
            self._log(f"ERROR: Error when starting the HTML5 animation recording: {path}")
            return False
        self._animation = _Animation(path, self._world, self._arena)
        return True

    def stop_animation(self) -> bool:
        """Write the animation; False if its files cannot be written."""
        animation, self._animation = self._animation, None
        if animation is None:
            return True
        try:
            if not animation.save():
                self._log(
                    "INFO: Error: No animation content is available because no changes occurred "
                    "in the simulation."
                )
        except OSError as error:
            self._log(f"WARNING: Error when stopping the HTML5 animation recording: {error}")
            return False
        return True


class _Movie:
    """Pictures that are collected in a temporary file, and written as one file at the end."""

    def __init__(self, path: Path, size: tuple[int, int], quality: int) -> None:
        self._path, self._size, self._quality = path, size, quality
        self._pictures: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 - until the movie ends
        weakref.finalize(self, self._pictures.close)  # also where the world is loaded again
        self._due_ms = 0.0
        self.sizes: list[int] = []

    def note(self, time_ms: float, arena: Arena, labels: Sequence[Label]) -> None:
        """Take a picture if one is due, or if time has gone back."""
        if self._due_ms - 2 * _FRAME_MS < time_ms < self._due_ms:
            return
        self._due_ms = time_ms + _FRAME_MS - 1e-6
        jpeg = io.BytesIO()
        picture = draw_view(arena, time_ms / 1000.0, labels).resize(self._size)
        picture.save(jpeg, "JPEG", quality=self._quality)
        self.sizes.append(self._pictures.write(jpeg.getvalue()))

    def save(self) -> None:
        """Write the movie.

        Raises:
            OSError: It cannot be written.
        """
        self._pictures.seek(0)
        with self._pictures, self._path.open("wb") as file:
            file.write(_box("ftyp", b"isom\0\0\2\0isomiso2mp41"))
            begin = file.tell() + 8
            file.write(struct.pack(">I4s", 8 + sum(self.sizes), b"mdat"))
            file.write(self._pictures.read())
            file.write(_index(self.sizes, begin, self._size))


def _box(name: str, *content: bytes) -> bytes:
    """Return a box of an MP4 file (ISO/IEC 14496-12)."""
    body = b"".join(content)
    return struct.pack(">I4s", 8 + len(body), name.encode()) + body


def _full(name: str, flags: int, *content: bytes) -> bytes:
    return _box(name, struct.pack(">I", flags), *content)


def _index(sizes: Sequence[int], begin: int, size: tuple[int, int]) -> bytes:
    """Return the box that says where each picture is, and for how long it is shown."""
    count, each_ms = len(sizes), int(_FRAME_MS)
    length, (width, height) = count * each_ms, size
    unity = struct.pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    movie = struct.pack(">4IIH10x", 0, 0, 1000, length, 0x10000, 0x100)
    track = struct.pack(">5I8x4H", 0, 0, 1, 0, length, 0, 0, 0, 0)
    # MPEG-4 systems: a video stream (type 4) of JPEG pictures (object type 0x6C).
    decoder = struct.pack(">BBBBxHII", 0x04, 13, 0x6C, 0x11, 0, 0, 0)
    stream = struct.pack(">BBHB", 0x03, 3 + len(decoder) + 3, 1, 0) + decoder + b"\x06\x01\x02"
    entry = _box(
        "mp4v", bytes(6), struct.pack(">H16x2H2I4xH32xHh", 1, width, height, 72 << 16, 72 << 16,
                                      1, 24, -1), _full("esds", 0, stream),
    )  # fmt: skip
    table = _box(
        "stbl",
        _full("stsd", 0, struct.pack(">I", 1), entry),
        _full("stts", 0, struct.pack(">3I", 1, count, each_ms)),
        _full("stsc", 0, struct.pack(">4I", 1, 1, count, 1)),
        _full("stsz", 0, struct.pack(f">2I{count}I", 0, count, *sizes)),
        _full("stco", 0, struct.pack(">2I", 1, begin)),
    )
    place = _box("dinf", _full("dref", 0, struct.pack(">I", 1), _full("url ", 1)))
    media = _box(
        "mdia",
        _full("mdhd", 0, struct.pack(">4I2H", 0, 0, 1000, length, 0x55C4, 0)),
        _full("hdlr", 0, b"\0\0\0\0vide", bytes(13)),
        _box("minf", _full("vmhd", 1, bytes(8)), place, table),
    )
    seen = struct.pack(">2I", width << 16, height << 16)
    return _box(
        "moov",
        _full("mvhd", 0, movie, unity, bytes(24), struct.pack(">I", 2)),
        _box("trak", _full("tkhd", 3, track, unity, seen), media),
    )


class _Animation:
    """Poses of the bodies that move."""

    def __init__(self, path: Path, world: World, arena: Arena) -> None:
        self._path, self._world, self._arena = path, world, arena
        self._start = {body: self._pose(body) for body in arena.bodies}
        self._before = dict(self._start)
        self._moved: dict[Body, None] = {}
        self._frames: list[dict[str, Any]] = []
        self._begin_ms: float | None = None
        self._due_ms = 0.0

    def note(self, time_ms: float) -> None:
        """Record the bodies that moved since the last frame, if one is due."""
        if self._due_ms - 2 * _FRAME_MS < time_ms < self._due_ms:
            return
        self._due_ms = time_ms + _FRAME_MS - 1e-6
        if self._begin_ms is None:
            self._begin_ms = time_ms
        updates: list[dict[str, Any]] = []
        for body in self._arena.bodies:
            pose = self._pose(body)
            if pose != self._before.get(body):
                self._before[body] = pose
                self._moved[body] = None
                self._start.setdefault(body, pose)
                updates.append(pose)
        self._frames.append({"time": round(time_ms - self._begin_ms), "updates": updates})

    def _pose(self, body: Body) -> dict[str, Any]:
        return {
            "id": self._world.id_of(body.node),
            "translation": f"{body.x:.6g} {body.y:.6g} {body.z:.6g}",
            "rotation": f"0 0 1 {body.yaw_rad:.6g}",
        }

    def save(self) -> bool:
        """Write the files; False if nothing moved, so that, as of Webots, the JSON is not whole.

        Raises:
            OSError: They cannot be written.
        """
        head = {"basicTimeStep": _FRAME_MS, "labelsIds": ""}
        begin = json.dumps(head)[:-1] + ', "frames":[\n{"time":0,"updates":['
        data = self._path.with_suffix(".json")
        if not self._moved:
            data.write_text(begin, "utf-8")
            return False
        first = ",".join(json.dumps(self._start[body]) for body in self._moved)
        frames = ",\n".join(json.dumps(frame) for frame in self._frames)
        whole = f"{begin}{first}]}},\n{frames}\n ]\n}}\n"
        data.write_text(whole, "utf-8")
        bodies = [self._outline(body) for body in self._arena.bodies]
        page = _PAGE.read_text("utf-8")
        page = page.replace("/*BODIES*/[]", json.dumps(bodies).replace("<", "\\u003c"))
        self._path.write_text(page.replace("/*DATA*/{}", whole.strip()), "utf-8")
        return True

    def _outline(self, body: Body) -> dict[str, Any]:
        """Return the shapes of a body where it is now, for the page."""
        shapes: list[dict[str, Any]] = []
        for shape in body.shapes:
            size: dict[str, Any] = (
                {
                    "half": [shape.half_x_m, shape.half_y_m],
                    "turn": [shape.cos_yaw, shape.sin_yaw],
                }
                if isinstance(shape, UprightBox)
                else {"radius": shape.radius_m}
            )
            color = [round(255 * part) for part in shape.color]
            shapes.append({"x": shape.x, "y": shape.y, "color": color, **size})
        place = {"x": body.x, "y": body.y, "yaw": body.yaw_rad}
        return {"id": self._world.id_of(body.node), **place, "shapes": shapes}
