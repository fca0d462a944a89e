"""Records the states that a controller publishes.

Each call is counted, tested against breakpoints and the goal of a run, and recorded or held.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Any, Final, cast

from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.claimed_commands import Reloads
from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.devices import DeviceReader
from webots_mcp.bridge.encoding import StateEncoder
from webots_mcp.bridge.episode import Episode
from webots_mcp.bridge.error_report import cut
from webots_mcp.bridge.full_rate import FullRateRecorder
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.json_cleaning import MAX_KEY_CHARACTERS, key_text
from webots_mcp.bridge.recorder import Recorder, this_call
from webots_mcp.bridge.run_goal import Watch
from webots_mcp.bridge.simulation import Clock
from webots_mcp.bridge.throttle import Throttle
from webots_mcp.database.tapes import tape_notes
from webots_mcp.signals.register import SignalNames, StateChanges

_BYTES_PER_CHARACTER: Final = 6  # of JSON: a number of 10 characters and its key take 100 bytes


class Publisher:
    """Handles each call of `publish` and `auto_publish`.

    Args:
        begin_run: Called if simulation time has gone back since the last call.

    Attributes:
        recorded: Number of recorded calls.
        total_s: The time that they took together, in seconds.
        longest_s: The time that the longest of them took.
        devices: Reads the devices for `auto_publish`.
        episode: Sums up the reward of the run.
    """

    def __init__(
        self,
        clock: Clock,
        recorder: Recorder,
        journal: Journal,
        heartbeat: Heartbeat,
        throttle: Throttle,
        breakpoints: Breakpoints,
        watch: Watch,
        full_rate: FullRateRecorder,
        devices: DeviceReader,
        reloads: Reloads,
        variables: ControllerVariables,
        begin_run: Callable[[], None],
    ) -> None:
        if tape_notes.replayed is not None:
            tape_notes.replayed.bridge_begins()
        self._clock = clock
        self._recorder = recorder
        self._journal = journal
        self._heartbeat = heartbeat
        self._throttle = throttle
        self._breakpoints = breakpoints
        self._watch = watch
        self._full_rate = full_rate
        self._reloads = reloads
        self._variables = variables
        self._begin_run = begin_run
        self._encoder = StateEncoder()
        self._changes = StateChanges()
        self._names = SignalNames()
        recorder.new_database_entries.append(self._names.begin_anew)
        self.devices = devices
        self.episode = Episode(recorder)
        self._run = clock.run
        self._own_bytes = 0  # that a state of the devices takes in memory, about
        self.recorded = 0
        self.total_s = self.longest_s = 0.0

    def publish(self, state: Mapping[Any, Any], force: bool) -> None:
        """Record the state if this call is due, a breakpoint is hit or a goal is reached."""
        if tape_notes.replayed is not None:
            tape_notes.replayed.publishes(state)
        if self._clock.update():
            self._begin_run()
        self.episode.add(state)
        self._evaluate(state, force, 0)

    def _evaluate(self, state: Mapping[Any, Any], force: bool, own_bytes: int) -> None:
        wanted, hit, full_rate, breakpoints = force, None, self._full_rate, self._breakpoints
        if self._variables.watches is not None:
            state = self._variables.watches.added_to(state, this_call())
        # Checked before the call, since even a call that does nothing slows down every `publish`.
        if breakpoints.armed or breakpoints.run is not self._clock.run:
            hit = breakpoints.evaluate(state)
            wanted |= breakpoints.reaches  # `webots-mcp check` needs its row
        if self._watch.asks_states:
            wanted = self._watch.evaluate(state) or wanted
        if self._throttle.admits(wanted or hit or self._heartbeat.loop):
            self._record(state)
        elif full_rate.fills:
            full_rate.add(state, own_bytes)
        if full_rate.frames.cameras:
            self._take_camera_frames(at_once=bool(hit))
        if hit:
            breakpoints.act(hit, state)  # after recording: a pause must show the state of the hit
        if full_rate.busy:
            full_rate.go_on()

    def publish_devices(
        self, extra: Mapping[Any, Any], include_time: bool, force: bool = False
    ) -> dict[Any, Any] | None:
        """Record the devices' values; they are read only if this call is due.

        While breakpoints are armed or a run has a goal, every call reads them. For the ring buffer
        they are read as often as the limit on reading time allows.

        Returns:
            The state; None if the devices were not read.
        """
        state = None
        if tape_notes.replayed is not None:
            tape_notes.replayed.publishes(extra)
        if self._clock.update():
            self._begin_run()
        self.episode.add(extra)
        full_rate, throttle = self._full_rate, self._throttle
        due = full_rate.fills and (throttle.calls + 1) % self.devices.ring_interval == 0
        if due or self._breakpoints.must_evaluate() or self._watch.asks_states:
            state = self._read(extra, include_time)
            # The devices' values are new objects in each call: no other code can change them.
            self._evaluate(state, force, 0 if extra else self._own_bytes)
            return state
        if throttle.admits(force or self._heartbeat.loop is not None):
            state = self._read(extra, include_time)
            watches = self._variables.watches
            self._record(state if watches is None else watches.added_to(state, this_call()))
        elif full_rate.fills:
            full_rate.leave_out(self.devices.why)
        if full_rate.frames.cameras:
            self._take_camera_frames(at_once=False)
        if full_rate.busy:
            full_rate.go_on()
        return state

    def unread(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        """Return the state without the devices: the time and `extra`."""
        return ({"time": self._clock.sim_time_s} if include_time else {}) | _finite(extra)

    def _take_camera_frames(self, *, at_once: bool) -> None:
        """Hold due camera frames with the states; at a hit take one of each camera."""
        full_rate = self._full_rate
        if at_once or full_rate.frames.is_due(self._clock.sim_time_s):
            full_rate.take_camera_frames(at_once=at_once)

    def _read(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        return self.devices.read() | self.unread(extra, include_time)

    def _record(self, state: Mapping[Any, Any]) -> None:
        started_s = time.perf_counter()
        self._reloads.fire()
        encoded = self._encoder.encode(state)
        if not encoded.text.startswith("{"):
            raise TypeError(f"publish() takes a dict, got {type(state).__name__}")
        self._journal.state(encoded)
        if isinstance(state, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            self._record_changes(state)
        self._own_bytes = _BYTES_PER_CHARACTER * len(encoded.text)
        self._names.register(state, encoded.text, self._recorder.enter_signals)
        if self._variables.watches is not None:
            self._variables.watches.recorded()
        self._heartbeat.beat_if_due()
        self._count(time.perf_counter() - started_s)

    def _count(self, duration_s: float) -> None:
        self.recorded += 1
        self.total_s += duration_s
        if duration_s > self.longest_s:
            self.longest_s = duration_s

    def _record_changes(self, state: Mapping[Any, Any]) -> None:
        if self._clock.run is not self._run:
            self._run = self._clock.run
            self._changes.forget()
        for name, before, after in self._changes.compare(state):
            shown = cut(key_text(name), MAX_KEY_CHARACTERS)
            self._journal.event("change", {"from": before, "to": after}, shown)


def _finite(extra: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return a mapping as a dict of `len` items, since a user's own mapping may be endless."""
    if extra.__class__ is dict:
        return cast("dict[Any, Any]", extra)
    if not isinstance(extra, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"a state must be a dict, got {type(extra).__name__}")
    return dict(islice(extra.items(), len(extra)))
