"""Processing a published state: throttling, encoding, recording, and comparing it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import islice
from typing import Any, cast

from webots_mcp.bridge.change_detector import Changes
from webots_mcp.bridge.context import Context
from webots_mcp.bridge.device_reader import DeviceReader
from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.run_starts import Runs
from webots_mcp.bridge.signal_names import SignalNames
from webots_mcp.bridge.stats import PublishCost


class Publisher:
    """Handles each call of `publish` and `auto_publish`.

    Attributes:
        cost: How long the recorded calls took.
        devices: Reads the devices for `auto_publish`.
    """

    def __init__(self, context: Context, runs: Runs) -> None:
        self._context = context
        self._clock = context.clock
        self._heartbeat = context.heartbeat
        self._throttle = context.throttle
        self._breakpoints = context.breakpoints
        self._watch = context.watch
        self._keeper = context.keeper
        self._runs = runs
        self._changes = Changes()
        self._names = SignalNames(context.recorder)
        self.devices = DeviceReader(context.simulation, context.journal, context.recorder.errors)
        self._run = context.clock.run
        self.cost = PublishCost()

    def publish(self, state: Mapping[Any, Any], force: bool) -> None:
        """Record the state if this call is due, a breakpoint is hit or a goal is reached."""
        if self._clock.look():
            self._runs.begin()
        wanted, hit, keeper, breakpoints = force, None, self._keeper, self._breakpoints
        # Tested here, since even an empty call would slow down every `publish`.
        if breakpoints.armed or breakpoints.run is not self._clock.run:
            hit = breakpoints.look(state)
        if self._watch.asks_states:
            wanted = self._watch.look(state) or wanted
        if self._throttle.admits(wanted or hit or self._heartbeat.loop):
            self._record(state)
        elif keeper.fills:
            keeper.add(state)
        if keeper.frames.cameras:
            self._look_at_cameras(at_once=bool(hit))
        if hit:
            breakpoints.act(hit, state)  # after recording: a pause must show the state of the hit
        if keeper.busy:
            keeper.go_on()

    def publish_devices(
        self, extra: Mapping[Any, Any], include_time: bool, force: bool = False
    ) -> dict[Any, Any] | None:
        """Record the devices' values; they are read if this call is due.

        Where breakpoints are armed or a run has a goal, they are read in every call; for the ring
        buffer as often as the limit on the time for reading allows.

        Returns:
            The state; None where the devices were not read.
        """
        state = None
        if self._clock.look():
            self._runs.begin()
        keeper, throttle = self._keeper, self._throttle
        due = keeper.fills and (throttle.calls + 1) % self.devices.ring_interval == 0
        if due or self._breakpoints.ask_states() or self._watch.asks_states:
            state = self._read(extra, include_time)
            self.publish(state, force)
            return state
        if throttle.admits(force or self._heartbeat.loop is not None):
            state = self._read(extra, include_time)
            self._record(state)
        elif keeper.fills:
            keeper.leave_out(self.devices.why)
        if keeper.frames.cameras:
            self._look_at_cameras(at_once=False)
        if keeper.busy:
            keeper.go_on()
        return state

    def unread(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        """A state without the devices."""
        return ({"time": self._clock.sim_time_s} if include_time else {}) | _finite(extra)

    def _look_at_cameras(self, *, at_once: bool) -> None:
        """Hold due camera frames with the states; at a hit take one of each camera."""
        keeper = self._keeper
        if at_once or keeper.frames.is_due(self._clock.sim_time_s):
            keeper.look_at_cameras(at_once=at_once)

    def _read(self, extra: Mapping[Any, Any], include_time: bool) -> dict[Any, Any]:
        return self.devices.read() | self.unread(extra, include_time)

    def _record(self, state: Mapping[Any, Any]) -> None:
        started_s = time.perf_counter()
        self._context.reloads.fire()
        encoded = encode(state)
        if not encoded.text.startswith("{"):
            raise TypeError(f"publish() takes a dict, got {type(state).__name__}")
        self._context.journal.state(encoded)
        if isinstance(state, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
            self._record_changes(state)
        self._names.look(state, encoded.text)
        self._heartbeat.beat_if_due()
        self.cost.add(time.perf_counter() - started_s)

    def _record_changes(self, state: Mapping[Any, Any]) -> None:
        if self._clock.run is not self._run:
            self._run = self._clock.run
            self._changes.forget()
        for name, before, after in self._changes.look(state):
            self._context.journal.event("change", {"from": before, "to": after}, name)


def _finite(extra: Mapping[Any, Any]) -> dict[Any, Any]:
    """A mapping as a dict of `len` items: the iterator of a user's own mapping may be endless."""
    if extra.__class__ is dict:
        return cast("dict[Any, Any]", extra)
    if not isinstance(extra, Mapping):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise TypeError(f"a state must be a dict, got {type(extra).__name__}")
    return dict(islice(extra.items(), len(extra)))
