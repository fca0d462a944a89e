"""Keeping the seconds around a moment at full rate: a ring buffer before it, each call after it.

Throttled calls go into the ring. `keep` writes the ring to the table `kept_state`, in order and
some rows with each call of the loop; each throttled call of the next seconds follows. Together with
the recorded rows this is every call of a kept stretch, whose begin, end and reason are in the table
`kept_stretch`. Small frames of the cameras that the controller names are held and kept with them,
one file with each call.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from array import array
from collections import deque
from itertools import islice
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.encoding import copy_or_encode, encode, encode_copy
from webots_mcp.bridge.error_report import cut, describe, storable
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pictures import Album, HeldFrame, image_of
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.bridge.state_copies import StateCopier, StateCopy
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import KEEP_AFTER_S, new_uuid

MOST_KEPT_S: Final = 600.0  # of one run; a condition that flickers would keep all of it
_MOST_REASONS: Final = 10  # of one stretch that are stored
_MOST_REASON_CHARACTERS: Final = 200
# These limit a call to about 1.5 ms, encoding included. Processor time: by the wall clock, another
# process that runs in between would leave fewer rows per call.
_ROWS_AT_ONCE: Final = 100
_ENCODING_AT_ONCE_S: Final = 0.0005
_CHARACTERS_AT_ONCE: Final = 200_000
MAX_RING_BYTES: Final = 8_000_000
_COPY_BYTES: Final = 90  # of a copy in addition to its values
_ROW_BYTES: Final = 400  # of a row in addition to its state: a tuple, three numbers, its place
LONGEST_SIDE_PX: Final = 160
MOST_FRAMES: Final = 78  # of all cameras together: 8 MB, were they square
_MOST_FRAMES_PER_S: Final = 100.0
_EARLY_S: Final = 1e-9  # tolerance: summed floating-point steps may fall a little short
_METHODS: Final = ("getName", "getSamplingPeriod", "getWidth", "getHeight", "getImage")


class Stretch:
    """A kept stretch of a run; `end_s` is in the future while it is being recorded.

    Attributes:
        gaps: Why calls are missing in it; None where none is.
    """

    def __init__(self, run: CurrentRun, start_s: float) -> None:
        self.uuid = new_uuid()
        self.run = run
        self.start_s = self.end_s = start_s
        self.wall_time_s = time.time()
        self.reasons: list[str] = []
        self.gaps: str | None = None

    @property
    def reason(self) -> str:
        """All reasons, and what is missing."""
        return "; ".join([*self.reasons, *filter(None, [self.gaps])])

    def add_reason(self, reason: str) -> None:
        """Add a reason for keeping it, if it is new."""
        text = storable(cut(reason, _MOST_REASON_CHARACTERS))
        # An exception is also logged, as "error: " and the same text.
        is_known = any(f": {text}".endswith(f": {known}") for known in self.reasons)
        if not is_known and len(self.reasons) < _MOST_REASONS:
            self.reasons.append(text)


class Keeper:
    """Holds the last seconds in memory, and writes them to the database on request.

    Args:
        last_s: Seconds of simulation time before a moment that are kept; 0 keeps nothing.

    Attributes:
        frames: Takes and holds small frames of cameras.
        fills: Each throttled call has to be added.
        busy: `go_on` has to be called with each round of the loop.
        enabled: Whether anything is held at all.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        album: Album,
        throttle: Throttle,
        last_s: float,
    ) -> None:
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._album = album
        self._throttle = throttle
        self._last_s = last_s
        self._ring = Ring(last_s)
        self._copier = StateCopier()
        self._run = clock.run
        self._ring.begin(clock.sim_time_s)
        self._kept_s = 0.0
        self._left_out: tuple[float, str] | None = None  # this run's last call that was not held
        self._stretch: Stretch | None = None
        self._going_on = False
        self._asked: deque[tuple[CurrentRun, str]] = deque(maxlen=_MOST_REASONS)
        self._unwritten: deque[tuple[CurrentRun, RingRow]] = deque()
        self._unwritten_frames: deque[tuple[Stretch, HeldFrame]] = deque()
        self._lock = threading.RLock()  # of all that is held: any thread may publish
        self.frames = CameraFrames(journal, last_s)
        self.enabled = last_s > 0
        self.fills = self.enabled and throttle.interval > 1
        self.busy = False

    # -- the loop ------------------------------------------------------------------------------

    def add(self, state: object, own_bytes: int = 0) -> None:
        """Add a call of `publish` that is not recorded.

        Args:
            state: Is copied, unless it is known that nothing will change it.
            own_bytes: The memory that such a state takes, about; 0 where it has to be copied.
        """
        clock, replaced = self._clock, None
        held: object
        if own_bytes:
            held, size_bytes = state, own_bytes
        elif (copy := self._copier.copy(state)) is not None:
            held, size_bytes = copy, len(copy.values) + _COPY_BYTES
        else:
            held, replaced = _copied(state)
            if held is None:
                return  # not a dict: the next recorded call reports that
            size_bytes = sys.getsizeof(held)
        now_s = clock.sim_time_s
        row = RingRow(
            self._throttle.calls, now_s, time.time(), held, replaced, _ROW_BYTES + size_bytes
        )
        with self._lock:
            if clock.run is not self._run:
                self._begin_run()
            if self._stretch is not None and now_s > self._stretch.end_s:
                self._end_stretch(self._stretch.end_s)
            if self._going_on:
                self._unwritten.append((clock.run, row))
            else:
                self._ring.add(row)

    def take_camera_frames(self, *, at_once: bool) -> None:
        """Take a small frame of each camera whose frame is due; `at_once` of all cameras."""
        now_s = self._clock.sim_time_s
        # Without the lock, since Webots may be slow.
        frames = self.frames.take_due(now_s, at_once=at_once)
        with self._lock:
            if self._clock.run is not self._run:
                self._begin_run()
            stretch = self._stretch
            if stretch is not None and now_s > stretch.end_s:
                self._end_stretch(stretch.end_s)
            for frame in frames:
                if self._going_on and stretch is not None:
                    self._keep_frame(stretch, frame)
                else:
                    self.frames.add(frame)

    def leave_out(self, why: str) -> None:
        """Note that a call is neither recorded nor held; its stretch then names the reason."""
        with self._lock:
            if self._clock.run is not self._run:
                self._begin_run()
            now_s = self._clock.sim_time_s
            self._left_out = now_s, why
            stretch = self._stretch if self._going_on else None
            if stretch is not None and now_s <= stretch.end_s and not stretch.gaps:
                stretch.gaps = why
                self._record(stretch)

    def go_on(self) -> None:
        """Begin the requested stretches, write some rows, and end the stretch when it is over."""
        with self._lock:
            self._keep_asked()
            self._write_some()
            if self._stretch is not None and self._clock.sim_time_s >= self._stretch.end_s:
                self._end_stretch(self._stretch.end_s)
            left = self._unwritten or self._unwritten_frames or self._asked
            self.busy = bool(self._going_on or left)

    # -- keeping -------------------------------------------------------------------------------

    def ask(self, reason: str) -> None:
        """Request a stretch, which the next round of the loop begins; from any thread."""
        if self.enabled:
            self._asked.append((self._clock.run, reason))
            self.busy = True

    def keep(self, reason: str) -> bool:
        """Keep the last seconds and the next ones; False where that is not possible."""
        with self._lock:
            if self._clock.run is not self._run:
                self._begin_run()
            return self._keep_around(self._clock.sim_time_s, reason)

    @property
    def why_not(self) -> str:
        """Why nothing can be kept."""
        if not self.enabled:
            return "the bridge holds nothing to keep: keep_last_s is 0"
        return f"{MOST_KEPT_S:g} s of this run are kept at full rate already, which is the limit"

    def write_all(self) -> None:
        """Write all requested stretches now: the loop is about to stop, so no call would follow."""
        with self._lock:
            self._keep_asked()
        while self._unwritten or self._unwritten_frames:
            self._write_some()

    def close(self) -> None:
        """The session ends: write everything, and end the stretch that is being recorded."""
        self.write_all()
        with self._lock:
            self._end_stretch(self._clock.sim_time_s)

    def abandon(self) -> None:
        """In a forked child: the thread that may have had the lock was not forked."""
        self._lock = threading.RLock()

    # -- inside --------------------------------------------------------------------------------

    def _keep_around(self, now_s: float, reason: str) -> bool:
        if not self.enabled or not self._may_keep():
            return False
        rows = self._ring.take()
        before_s = min(now_s - self._last_s, rows[0].sim_time_s if rows else now_s)
        start_s, stretch = max(self._ring.starts_s, before_s), self._stretch
        if stretch is None or start_s > stretch.end_s:
            stretch = self._stretch = Stretch(self._run, start_s)
        self._kept_s += now_s + KEEP_AFTER_S - max(start_s, stretch.end_s)
        stretch.end_s = now_s + KEEP_AFTER_S
        stretch.add_reason(reason)
        if self._left_out is not None and self._left_out[0] >= start_s:
            stretch.gaps = stretch.gaps or self._left_out[1]
        self._unwritten.extend((self._run, row) for row in rows)
        for frame in self.frames.take(start_s):
            self._keep_frame(stretch, frame)
        self._going_on = self.busy = True
        self._record(stretch)
        return True

    def _keep_asked(self) -> None:
        if self._clock.run is not self._run:
            self._begin_run()
        while self._asked:
            self.keep(self._asked.popleft()[1])

    def _may_keep(self) -> bool:
        if self._kept_s < MOST_KEPT_S:
            return True
        if self._kept_s < float("inf"):
            self._kept_s = float("inf")  # so that the warning is logged once per run
            self._journal.log("warning", "bridge", self.why_not)
        return False

    def _begin_run(self) -> None:
        """A new run has begun: keep what was asked for in the last one, and forget its ring."""
        ended_s = self._clock.ended_sim_time_s
        while self._asked and self._asked[0][0] is self._run:
            self._keep_around(ended_s, self._asked.popleft()[1])
        self._end_stretch(ended_s)
        self._run, self._stretch, self._kept_s = self._clock.run, None, 0.0
        self._left_out = None
        self._ring.begin(self._run.started_sim_time_s)
        self.frames.take(math.inf)

    def _end_stretch(self, at_s: float) -> None:
        """End the stretch, but remember it: one that begins soon after continues it."""
        stretch = self._stretch
        if not self._going_on or stretch is None:
            return
        self._going_on = False
        self._ring.begin(at_s)
        if at_s < stretch.end_s:
            stretch.end_s = at_s
            self._record(stretch)

    def _record(self, stretch: Stretch) -> None:
        values = {
            "uuid": stretch.uuid,
            "start": stretch.start_s,
            "end": stretch.end_s,
            "wall_time": stretch.wall_time_s,
            "reason": stretch.reason,
        }
        self._recorder.record("kept stretch", stretch.run, values)

    def _keep_frame(self, stretch: Stretch, frame: HeldFrame) -> None:
        if len(self._unwritten_frames) < 2 * MOST_FRAMES:
            self._unwritten_frames.append((stretch, frame))
        else:  # frames arrive faster than one file per call can be written
            self.frames.missed += 1

    def _write_some(self) -> None:
        with self._lock:
            self._write_rows()
            if self._unwritten_frames:
                self._write_frame(*self._unwritten_frames[0])

    def _write_frame(self, stretch: Stretch, frame: HeldFrame) -> None:
        """Write one frame: to compress and write a file takes about a millisecond."""
        try:
            self._album.add_kept(stretch.run, stretch.uuid, frame)
        except OSError as error:
            self.frames.missed += 1
            self._recorder.errors.failed("keep_camera", error)
        finally:
            self._unwritten_frames.popleft()

    def _write_rows(self) -> None:
        """Write some rows of one run, in one transaction.

        They are forgotten after it: rows that an interrupt lets be written twice do no harm.
        """
        rows = list[tuple[int, float, float, str, str | None]]()
        room, until_s = _CHARACTERS_AT_ONCE, time.thread_time() + _ENCODING_AT_ONCE_S
        for run, row in islice(self._unwritten, _ROWS_AT_ONCE):
            if run is not self._unwritten[0][0] or room <= 0 or time.thread_time() > until_s:
                break
            rows.append(row.encode())
            room -= len(rows[-1][3])
        if rows:
            self._recorder.record_together("kept state", self._unwritten[0][0], rows)
        for _ in rows:
            self._unwritten.popleft()


class RingRow(NamedTuple):
    """A call of `publish` that may be kept.

    Attributes:
        call: Its number in the session.
        data: The text that would have been recorded, or a state or its copy, to encode later.
        replaced: The value of the column `replaced`, where `data` is a text.
        size_bytes: The memory that it takes, about.
    """

    call: int
    sim_time_s: float
    wall_time_s: float
    data: object
    replaced: str | None
    size_bytes: int

    def encode(self) -> tuple[int, float, float, str, str | None]:
        """The row as it would have been recorded."""
        if isinstance(self.data, str):
            return (*self[:3], self.data, self.replaced)
        data = self.data.state() if isinstance(self.data, StateCopy) else self.data
        encoded = encode_copy(data) if isinstance(data, bytes) else encode(data)
        return (*self[:3], encoded.text, encoded.replaced_text)


def _copied(state: object) -> tuple[str | bytes | None, str | None]:
    """A copy of a state, or its text with what was replaced; None of what is no dict."""
    held = copy_or_encode(state)
    if isinstance(held, bytes):
        return held, None
    return (held.text, held.replaced_text) if held.text.startswith("{") else (None, None)


class Ring:
    """Rows of one run, oldest first; the oldest are forgotten where they are too old or too many.

    Args:
        last_s: Seconds of simulation time that are held.
        most_bytes: The limit of memory in bytes; a single larger row is not held.

    Attributes:
        size_bytes: The memory that the rows take.
        starts_s: The simulation time since which no row is missing.
    """

    def __init__(self, last_s: float, most_bytes: int = MAX_RING_BYTES) -> None:
        self._last_s = last_s
        self._most_bytes = most_bytes
        self._rows: deque[RingRow] = deque()
        self.size_bytes = 0
        self.starts_s = 0.0

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: RingRow) -> None:
        """Add the newest row."""
        rows = self._rows
        rows.append(row)
        self.size_bytes += row.size_bytes
        oldest_s = row.sim_time_s - self._last_s
        while rows and (self.size_bytes > self._most_bytes or rows[0].sim_time_s < oldest_s):
            self._forget_oldest()

    def take(self) -> list[RingRow]:
        """Remove and return all rows."""
        rows = list(self._rows)
        self._rows.clear()
        self.size_bytes = 0
        return rows

    def begin(self, starts_s: float) -> None:
        """Empty the ring; rows are complete from that simulation time on."""
        self._rows.clear()
        self.size_bytes, self.starts_s = 0, starts_s

    def _forget_oldest(self) -> None:
        rows = self._rows
        row = rows.popleft()
        self.size_bytes -= row.size_bytes
        self.starts_s = rows[0].sim_time_s if rows else row.sim_time_s


class _Camera:
    """A camera of which frames are taken.

    Attributes:
        due_s: Simulation time of its next frame.
        missed: Frames that could not be taken.
    """

    def __init__(self, device: Any, interval_s: float) -> None:
        self.device = device
        self.name = str(device.getName())
        self.interval_s = interval_s
        self.due_s = self.taken_s = -math.inf
        self.missed = 0

    def frame(self, now_s: float) -> HeldFrame:
        """Its newest image, scaled down; the next frame is due no sooner than its next image."""
        self.taken_s = now_s
        period_s = self.device.getSamplingPeriod() / 1000
        self.due_s = now_s + max(self.interval_s, period_s) - _EARLY_S
        scaled = scale_down(*image_of(self.device))
        return HeldFrame(self.name, now_s, time.time(), *scaled)


class CameraFrames:
    """Takes frames of cameras, and holds those of the last seconds of a run.

    Args:
        last_s: Seconds of simulation time that are held, in 78 frames at most.

    Attributes:
        cameras: The cameras of which frames are taken, by name.
        missed: Frames that could not be taken or written.
    """

    def __init__(self, journal: Journal, last_s: float) -> None:
        self._journal = journal
        self._last_s = last_s
        self._held: deque[HeldFrame] = deque(maxlen=MOST_FRAMES)
        self._taken_s = self._due_s = -math.inf
        self.cameras: dict[str, _Camera] = {}
        self.missed = 0

    def watch(self, device: Any, frames_per_s: float) -> None:
        """Take this many frames of a camera per second of simulation time.

        Raises:
            TypeError: It is not a camera.
            ValueError: The number is out of bounds.
        """
        lacking = [name for name in _METHODS if not callable(getattr(device, name, None))]
        if lacking:
            kind = type(device).__name__
            raise TypeError(f"a Camera is needed, and {kind} has no {', '.join(lacking)}")
        if not 0 < frames_per_s <= _MOST_FRAMES_PER_S:
            most = f"{_MOST_FRAMES_PER_S:g}"
            raise ValueError(f"frames_per_s must be above 0 and at most {most}: {frames_per_s!r}")
        camera = _Camera(device, 1 / frames_per_s)
        self.cameras[camera.name] = camera
        self._due_s = -math.inf

    def is_due(self, now_s: float) -> bool:
        """Whether a frame is due, or simulation time has gone back."""
        return not self._taken_s <= now_s < self._due_s

    def take_due(self, now_s: float, *, at_once: bool) -> list[HeldFrame]:
        """The frames that are due; `at_once` one of each camera."""
        again = now_s < self._taken_s  # a new run
        due = [
            each
            for each in self.cameras.values()
            if again or now_s >= each.due_s or (at_once and now_s > each.taken_s)
        ]
        frames = [frame for each in due if (frame := self._frame_of(each, now_s)) is not None]
        self._taken_s = now_s
        self._due_s = min((each.due_s for each in self.cameras.values()), default=math.inf)
        return frames

    def add(self, frame: HeldFrame) -> None:
        """Hold the newest frame, and forget those that are too old."""
        while self._held and self._held[0].sim_time_s < frame.sim_time_s - self._last_s:
            self._held.popleft()
        self._held.append(frame)

    def take(self, start_s: float) -> list[HeldFrame]:
        """The frames taken since a simulation time; all held frames are forgotten."""
        frames = [frame for frame in self._held if frame.sim_time_s >= start_s]
        self._held.clear()
        return frames

    def _frame_of(self, camera: _Camera, now_s: float) -> HeldFrame | None:
        """A frame of a camera, or None where it has none; its second failure is logged."""
        try:
            return camera.frame(now_s)
        except Exception as error:  # noqa: BLE001  (the robot comes first)
            camera.missed += 1
            self.missed += 1
            if camera.missed == 2:  # the first one may come before the camera's first image
                self._journal.log("warning", "bridge", f"keep_camera: {describe(error)}")
            return None


def scale_down(bgra: bytes, width: int, height: int) -> tuple[int, int, bytes]:
    """Width, height and pixels of an image reduced to 160 pixels per side, by each n-th pixel.

    Raises:
        ValueError: The image does not have 4 * width * height bytes.
    """
    if len(bgra) != 4 * width * height:
        raise ValueError(f"{len(bgra)} bytes are not an image of {width} x {height} pixels")
    step = math.ceil(max(width, height) / LONGEST_SIDE_PX)
    if step <= 1:
        return width, height, bgra
    stride = 4 * width
    # Slices of an array are made at the speed of C, those of a memoryview pixel by pixel.
    rows = [array("I", bgra[i : i + stride])[::step] for i in range(0, len(bgra), stride * step)]
    return math.ceil(width / step), len(rows), b"".join(rows)
