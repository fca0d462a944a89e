"""Records the seconds around a moment at full rate: a ring buffer before it, each call after it.

Throttled calls go into the ring. `keep` writes the ring to the table `kept_state`, in order and
some rows with each call of the loop; each throttled call of the next seconds follows. Together with
the recorded rows this is every call of a full-rate segment, whose start, end and reason are in the
table `kept_stretch`. Small frames of the cameras that the controller names are held and written
likewise, one file with each call.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections import deque
from itertools import islice
from typing import Final, NamedTuple

from webots_mcp.bridge.camera_frames import MOST_FRAMES, CameraFrames
from webots_mcp.bridge.error_report import cut, storable
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.picture_files import HeldFrame, PictureFiles
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.ring import Ring, RingRow
from webots_mcp.bridge.simulation import Clock, CurrentRun
from webots_mcp.bridge.state_copies import StateCopier
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.contract import KEEP_AFTER_S, new_uuid


class FullRateLimits(NamedTuple):
    """Limits of full-rate segments.

    Attributes:
        run_s: Simulation time of one run at full rate; a condition that flickers would keep all of
            it.
        reasons: Reasons of one segment that are stored.
    """

    run_s: float = 600.0
    reasons: int = 10


_LIMITS: Final = FullRateLimits()


class _WritingLimits:
    """What one call of the loop writes, in about 1.5 ms with encoding.

    The time is processor time: by the wall clock, another process that runs in between would leave
    fewer rows per call.
    """

    ROWS: Final = 100
    ENCODING_S: Final = 0.0005
    CHARACTERS: Final = 200_000


class _MemoryBytes:
    """The memory of a held call in addition to its values, approximately."""

    COPY: Final = 90
    ROW: Final = 400  # a tuple, three numbers, its place


class KeptSegment:
    """A segment of a run of which every call is recorded.

    Attributes:
        end_s: Simulation time of its end, which is in the future while it is being recorded.
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
        text = storable(cut(reason, 200))
        # An exception is also logged, as "error: " and the same text.
        is_known = any(f": {text}".endswith(f": {known}") for known in self.reasons)
        if not is_known and len(self.reasons) < _LIMITS.reasons:
            self.reasons.append(text)


class FullRateRecorder:
    """Holds the last seconds in memory, and writes them to the database on request.

    Args:
        last_s: Seconds of simulation time before a moment that are kept; 0 keeps nothing.

    Attributes:
        frames: Takes and holds small frames of cameras.
        fills: Whether each throttled call has to be added.
        busy: Whether `go_on` has to be called in each round of the loop.
        enabled: Whether anything is held at all.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        files: PictureFiles,
        throttle: Throttle,
        last_s: float,
    ) -> None:
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._files = files
        self._throttle = throttle
        self._last_s = last_s
        self._ring = Ring(last_s)
        self._copier = StateCopier()
        self._run = clock.run
        self._ring.begin(clock.sim_time_s)
        self._kept_s = 0.0
        self._left_out: tuple[float, str] | None = None  # this run's last call that was not held
        self._segment: KeptSegment | None = None
        self._going_on = False
        self._asked: deque[tuple[CurrentRun, str]] = deque(maxlen=_LIMITS.reasons)
        self._unwritten: deque[tuple[CurrentRun, RingRow]] = deque()
        self._unwritten_frames: deque[tuple[KeptSegment, HeldFrame]] = deque()
        self._lock = threading.RLock()  # of all that is held: any thread may publish
        self.frames = CameraFrames(journal, last_s)
        self.enabled = last_s > 0
        self.fills = self.enabled and throttle.interval > 1
        self.busy = False

    # -- the loop ------------------------------------------------------------------------------

    def add(self, state: object, own_bytes: int = 0) -> None:
        """Add a call of `publish` that is not recorded.

        Args:
            state: The state; it is copied, unless it is known that nothing will change it.
            own_bytes: Approximate memory of a state that nothing will change; 0 to copy the state.
        """
        clock, replaced = self._clock, None
        held: object
        if own_bytes:
            held, size_bytes = state, own_bytes
        elif (copy := self._copier.copy(state)) is not None:
            held, size_bytes = copy, len(copy.values) + _MemoryBytes.COPY
        else:
            held, replaced = _copied(state)
            if held is None:
                return  # not a dict: the next recorded call reports that
            size_bytes = sys.getsizeof(held)
        now_s = clock.sim_time_s
        row = RingRow(
            self._throttle.calls, now_s, time.time(), held, replaced, _MemoryBytes.ROW + size_bytes
        )
        with self._lock:
            if clock.run is not self._run:
                self._begin_run()
            if self._segment is not None and now_s > self._segment.end_s:
                self._end_stretch(self._segment.end_s)
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
            segment = self._segment
            if segment is not None and now_s > segment.end_s:
                self._end_stretch(segment.end_s)
            for frame in frames:
                if self._going_on and segment is not None:
                    self._keep_frame(segment, frame)
                else:
                    self.frames.add(frame)

    def leave_out(self, why: str) -> None:
        """Note that a call is neither recorded nor held, so that its segment names the reason."""
        with self._lock:
            if self._clock.run is not self._run:
                self._begin_run()
            now_s = self._clock.sim_time_s
            self._left_out = now_s, why
            segment = self._segment if self._going_on else None
            if segment is not None and now_s <= segment.end_s and not segment.gaps:
                segment.gaps = why
                self._record(segment)

    def go_on(self) -> None:
        """Begin the requested segments, write some rows, and end the segment when it is over."""
        with self._lock:
            self._keep_asked()
            self._write_some()
            if self._segment is not None and self._clock.sim_time_s >= self._segment.end_s:
                self._end_stretch(self._segment.end_s)
            left = self._unwritten or self._unwritten_frames or self._asked
            self.busy = bool(self._going_on or left)

    # -- keeping -------------------------------------------------------------------------------

    def ask(self, reason: str) -> None:
        """Request a segment, which the next round of the loop begins; any thread may call this."""
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
        return f"{_LIMITS.run_s:g} s of this run are kept at full rate already, which is the limit"

    def write_all(self) -> None:
        """Write all requested segments now: the loop is about to stop, so no call would follow."""
        with self._lock:
            self._keep_asked()
        while self._unwritten or self._unwritten_frames:
            self._write_some()

    def close(self) -> None:
        """Write everything, and end the segment that is being recorded, when the session ends."""
        self.write_all()
        with self._lock:
            self._end_stretch(self._clock.sim_time_s)

    def abandon(self) -> None:
        """Replace the lock in a forked child: the thread that may have held it was not forked."""
        self._lock = threading.RLock()

    # -- inside --------------------------------------------------------------------------------

    def _keep_around(self, now_s: float, reason: str) -> bool:
        if not self.enabled or not self._may_keep():
            return False
        rows = self._ring.take()
        before_s = min(now_s - self._last_s, rows[0].sim_time_s if rows else now_s)
        start_s, segment = max(self._ring.starts_s, before_s), self._segment
        if segment is None or start_s > segment.end_s:
            segment = self._segment = KeptSegment(self._run, start_s)
        self._kept_s += now_s + KEEP_AFTER_S - max(start_s, segment.end_s)
        segment.end_s = now_s + KEEP_AFTER_S
        segment.add_reason(reason)
        if self._left_out is not None and self._left_out[0] >= start_s:
            segment.gaps = segment.gaps or self._left_out[1]
        self._unwritten.extend((self._run, row) for row in rows)
        for frame in self.frames.take(start_s):
            self._keep_frame(segment, frame)
        self._going_on = self.busy = True
        self._record(segment)
        return True

    def _keep_asked(self) -> None:
        if self._clock.run is not self._run:
            self._begin_run()
        while self._asked:
            self.keep(self._asked.popleft()[1])

    def _may_keep(self) -> bool:
        if self._kept_s < _LIMITS.run_s:
            return True
        if self._kept_s < float("inf"):
            self._kept_s = float("inf")  # so that the warning is logged once per run
            self._journal.log("warning", "bridge", self.why_not)
        return False

    def _begin_run(self) -> None:
        """Keep what was requested in the last run, and forget its ring: a new run has begun."""
        ended_s = self._clock.ended_sim_time_s
        while self._asked and self._asked[0][0] is self._run:
            self._keep_around(ended_s, self._asked.popleft()[1])
        self._end_stretch(ended_s)
        self._run, self._segment, self._kept_s = self._clock.run, None, 0.0
        self._left_out = None
        self._ring.begin(self._run.started_sim_time_s)
        self.frames.take(math.inf)

    def _end_stretch(self, at_s: float) -> None:
        """End the segment, but remember it: one that begins soon after continues it."""
        segment = self._segment
        if not self._going_on or segment is None:
            return
        self._going_on = False
        self._ring.begin(at_s)
        if at_s < segment.end_s:
            segment.end_s = at_s
            self._record(segment)

    def _record(self, segment: KeptSegment) -> None:
        values = {
            "uuid": segment.uuid,
            "start": segment.start_s,
            "end": segment.end_s,
            "wall_time": segment.wall_time_s,
            "reason": segment.reason,
        }
        self._recorder.record("kept stretch", segment.run, values)

    def _keep_frame(self, segment: KeptSegment, frame: HeldFrame) -> None:
        if len(self._unwritten_frames) < 2 * MOST_FRAMES:
            self._unwritten_frames.append((segment, frame))
        else:  # frames arrive faster than one file per call can be written
            self.frames.missed += 1

    def _write_some(self) -> None:
        with self._lock:
            self._write_rows()
            if self._unwritten_frames:
                self._write_frame(*self._unwritten_frames[0])

    def _write_frame(self, segment: KeptSegment, frame: HeldFrame) -> None:
        """Write one frame: to compress and write a file takes about a millisecond."""
        try:
            self._files.add_kept(segment.run, segment.uuid, frame)
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
        left, until_s = _WritingLimits.CHARACTERS, time.thread_time() + _WritingLimits.ENCODING_S
        for run, row in islice(self._unwritten, _WritingLimits.ROWS):
            if run is not self._unwritten[0][0] or left <= 0 or time.thread_time() > until_s:
                break
            rows.append(row.encode())
            left -= len(rows[-1][3])
        if rows:
            self._recorder.record_together("kept state", self._unwritten[0][0], rows)
        for _ in rows:
            self._unwritten.popleft()


def _copied(state: object) -> tuple[str | bytes | None, str | None]:
    """Return a copy of a state, or its text with what was replaced; None if it is not a dict."""
    from webots_mcp.bridge.state_pickles import copy_or_encode  # few controllers need pickle

    held = copy_or_encode(state)
    if isinstance(held, bytes):
        return held, None
    return (held.text, held.replaced_text) if held.text.startswith("{") else (None, None)
