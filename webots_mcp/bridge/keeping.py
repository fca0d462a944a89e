"""Keeping the seconds around a moment at full rate: a ring buffer before it, each call after it.

Throttled calls go into the ring. `keep` writes the ring to the table `kept_state`, in order and
some rows with each call of the loop; each throttled call of the next seconds follows. Together with
the recorded rows this is every call of a kept stretch, whose begin, end and reason are in the table
`kept_stretch`. Small frames of the cameras that the controller names are held and kept with them,
one file with each call.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from itertools import islice
from typing import Final

from webots_mcp.bridge.clock import Clock
from webots_mcp.bridge.encoding import copy_or_encode
from webots_mcp.bridge.frames import MOST_FRAMES, CameraFrames, Frame
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.picture_files import Album
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.ring import Ring, RingRow
from webots_mcp.bridge.run import Run
from webots_mcp.bridge.text import cut, storable
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


class Stretch:
    """A kept stretch of a run; `end_s` is in the future while it is being recorded.

    Attributes:
        gaps: Why calls are missing in it; None where none is.
    """

    def __init__(self, run: Run, start_s: float) -> None:
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
        self._run = clock.run
        self._ring.begin(clock.sim_time_s)
        self._kept_s = 0.0
        self._left_out: tuple[float, str] | None = None  # this run's last call that was not held
        self._stretch: Stretch | None = None
        self._going_on = False
        self._asked: deque[str] = deque(maxlen=_MOST_REASONS)
        self._unwritten: deque[tuple[Run, RingRow]] = deque()
        self._unwritten_frames: deque[tuple[Stretch, Frame]] = deque()
        self._lock = threading.RLock()  # of all that is held: any thread may publish
        self.frames = CameraFrames(journal, last_s)
        self.enabled = last_s > 0
        self.fills = self.enabled and throttle.interval > 1
        self.busy = False

    # -- the loop ------------------------------------------------------------------------------

    def add(self, state: object) -> None:
        """Add a call of `publish` that is not recorded."""
        clock = self._clock
        held, replaced = copy_or_encode(state), None
        if not isinstance(held, bytes):
            held, replaced = held.text, held.replaced_text
            if not held.startswith("{"):
                return  # not a dict: the next recorded call reports that
        row = RingRow(self._throttle.calls, clock.sim_time_s, time.time(), held, replaced)
        with self._lock:
            if clock.run is not self._run:
                self._begin_run()
            if self._stretch is not None and row.sim_time_s > self._stretch.end_s:
                self._end_stretch(self._stretch.end_s)
            if self._going_on:
                self._unwritten.append((clock.run, row))
            else:
                self._ring.add(row)

    def look_at_cameras(self, *, at_once: bool) -> None:
        """Take a small frame of each camera whose frame is due; `at_once` of all cameras."""
        now_s = self._clock.sim_time_s
        frames = self.frames.look(now_s, at_once=at_once)  # without the lock: Webots may be slow
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
            if self._clock.run is not self._run:
                self._begin_run()
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
            self._asked.append(reason)
            self.busy = True

    def keep(self, reason: str) -> bool:
        """Keep the last seconds and the next ones; False where that is not possible."""
        with self._lock:
            if not self.enabled or not self._may_keep():
                return False
            now_s = self._clock.sim_time_s
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

    def _keep_asked(self) -> None:
        while self._asked:
            self.keep(self._asked.popleft())

    def _may_keep(self) -> bool:
        if self._clock.run is not self._run:
            self._begin_run()
        if self._kept_s < MOST_KEPT_S:
            return True
        if self._kept_s < float("inf"):
            self._kept_s = float("inf")  # so that the warning is logged once per run
            self._journal.log("warning", "bridge", self.why_not)
        return False

    def _begin_run(self) -> None:
        """A new run has begun: forget what the ring holds of the last one."""
        self._end_stretch(self._clock.ended_sim_time_s)
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

    def _keep_frame(self, stretch: Stretch, frame: Frame) -> None:
        if len(self._unwritten_frames) < 2 * MOST_FRAMES:
            self._unwritten_frames.append((stretch, frame))
        else:  # frames arrive faster than one file per call can be written
            self.frames.missed += 1

    def _write_some(self) -> None:
        with self._lock:
            self._write_rows()
            if self._unwritten_frames:
                self._write_frame(*self._unwritten_frames[0])

    def _write_frame(self, stretch: Stretch, frame: Frame) -> None:
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
        rows = list[RingRow]()
        room, until_s = _CHARACTERS_AT_ONCE, time.thread_time() + _ENCODING_AT_ONCE_S
        for run, row in islice(self._unwritten, _ROWS_AT_ONCE):
            if run is not self._unwritten[0][0] or room <= 0 or time.thread_time() > until_s:
                break
            rows.append(row.encode())
            room -= len(rows[-1].data)
        if rows:
            self._recorder.record_together("kept state", self._unwritten[0][0], rows)
        for _ in rows:
            self._unwritten.popleft()
