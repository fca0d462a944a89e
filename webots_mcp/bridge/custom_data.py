"""Records robots without a bridge: an observer reads their field `customData`.

A controller in any language publishes with one call (`wb_robot_set_custom_data` in C). The field
holds one text, which supervisors see a step later. A JSON object gives the signals of a state, any
other text the one signal `custom_data`. A robot has a session of its own from its first text on, as
long as no other process records it. A bridge that starts later takes over.

Webots sends the field with each step (`enableSFTracking`), so that reading it is no request. A long
text is read once a second instead. No text stops the observer: long texts and texts that are not
JSON are cut, and a failure with one robot is reported and affects no other.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, NamedTuple, Protocol, cast

from webots_mcp.bridge.encoding import encode
from webots_mcp.bridge.error_report import ErrorReport, cut
from webots_mcp.bridge.journal import Heartbeat, Journal
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.registration import Identity, same_simulation
from webots_mcp.bridge.scene_nodes import SceneNode, find_field
from webots_mcp.bridge.simulation import Clock, LoopMeter, Simulation
from webots_mcp.contract import CUSTOM_DATA, HEARTBEAT_INTERVAL_S, recorded_name
from webots_mcp.database.processes import is_living
from webots_mcp.signals.register import SignalNames, StateChanges

TEXT: Final = "custom_data"  # the signal of a text that is no JSON object
MISSED: Final = "seq_missed"  # how many messages of this run were overwritten before a reading
_PLACE: Final = frozenset(("x_m", "y_m", "z_m", "heading_rad"))  # they stay together
SEEN: Final = "seen"  # the branch of the pose where a robot publishes one of its keys itself
LONGEST_TEXT: Final = 65_536  # characters that are taken for JSON, and sent with each step


@dataclass(frozen=True)
class CustomDataLimits:
    """How `customData` is read.

    Attributes:
        signal_characters: Characters of a text that is not JSON, as a signal.
        long_text_s: Wall time between two readings of a long text.
        new_robots: New robots whose fields are searched in one round.
        stale_s: Simulation time after a reset in which the text from before it is not recorded.
        delay_steps: Steps after a reset in which a new text may be from before it.
        epsilon_s: Tolerance for rounding in summed steps.
        rest_s: Wall time after the end of another recording in which a robot is not taken over.
    """

    signal_characters: int = 1_000
    long_text_s: float = 1.0
    new_robots: int = 10
    stale_s: float = 1.0
    delay_steps: int = 2
    epsilon_s: float = 1e-9
    rest_s: float = 2.0


_LIMITS: Final = CustomDataLimits()
# Strings, which stay as they are, and what C prints for numbers that JSON does not have.
_C_NUMBERS: Final = re.compile(
    r'"(?:\\.|[^"\\])*"?|([-+]?)\b(?:(nan)\b(?:\(\w*\))?|inf(?:inity)?\b)', re.IGNORECASE
)
# What Webots' PROTO Car keeps there for its vehicle library: seven numbers, the engine's letter.
_OF_CAR: Final = re.compile(r"(?:[-+.\de]+ ){7}[CEPS] ")


class SeenRobot(Protocol):
    """A robot as an observer follows it: its node, and its fields `name` and `controller`."""

    scene: SceneNode
    name: str
    controller: str

    @property
    def is_there(self) -> bool:
        """Return whether its node is still in the world."""
        ...

    def pose_now(self) -> dict[str, float] | None:
        """Return its pose as signals; None without a pose."""
        ...


def signals_of(text: str) -> dict[str, Any]:
    """Return the members of a JSON object; of any other text the signal `custom_data`.

    `nan` and `inf`, as C prints them, are read like JSON's NaN and Infinity.
    """
    value: Any = cut(text, _LIMITS.signal_characters)
    if len(text) <= LONGEST_TEXT:
        for read in (str, _with_json_numbers):
            with suppress(ValueError, RecursionError):
                value = json.loads(read(text), strict=False)
                break
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {TEXT: value}


def _with_json_numbers(text: str) -> str:
    def spelled(found: re.Match[str]) -> str:
        if found[0].startswith('"'):
            return found[0]
        return "NaN" if found[2] else f"{found[1].strip('+')}Infinity"

    return _C_NUMBERS.sub(spelled, text)


class ObserverParts(NamedTuple):
    """The parts of the observer's own bridge that recording other robots needs."""

    identity: Identity
    simulation: Simulation
    clock: Clock
    recorder: Recorder
    journal: Journal
    errors: ErrorReport


class CustomDataReader:
    """Reads `customData` of the robots of a world, and records robots that nothing else records.

    Args:
        observer: What is known of the observer itself, and its recorder.
    """

    def __init__(self, observer: ObserverParts) -> None:
        self._observer = observer
        self._robots: dict[int, _Robot] = {}  # by the id of the body
        self._taken: set[str] = set()  # names of robots that other processes record
        self._taken_at_s: dict[str, float] = {}  # when each was so last
        self._check_sessions_s = 0.0

    def read_all(self, bodies: Iterable[SeenRobot], *, is_due: bool) -> None:
        """Read all fields and record the texts that are new.

        Args:
            bodies: The robots that are followed now.
            is_due: Also record a row of each robot that has written nothing new.
        """
        now_s = time.monotonic()
        if now_s >= self._check_sessions_s:
            self._check_sessions_s = now_s + HEARTBEAT_INTERVAL_S
            self._taken = self._names_taken()
        robots = {id(body): body for body in bodies}
        for key in self._robots.keys() - robots.keys():
            self._robots.pop(key).end("finished")
        for key in list(robots.keys() - self._robots.keys())[: _LIMITS.new_robots]:
            self._robots[key] = _Robot(robots[key], self._observer)
        waiting = [robot for robot in self._robots.values() if self._read(robot, now_s, is_due)]
        if waiting:  # one in a round, since it takes milliseconds
            self._taken = self._names_taken()
            free = (robot for robot in waiting if recorded_name(robot.body.name) not in self._taken)
            for robot in islice(free, 1):
                robot.begin()

    def _read(self, robot: _Robot, now_s: float, is_due: bool) -> bool:
        """Read one robot; return whether it has written something and has no session yet."""
        try:
            return robot.read(
                now_s, is_due=is_due, is_taken=recorded_name(robot.body.name) in self._taken
            )
        except Exception as error:  # noqa: BLE001  (the other robots are read nevertheless)
            self._observer.errors.failed(f"customData of {robot.body.name}", error)
            return False

    def close(self) -> None:
        """End all recordings, because the observer or the world ends."""
        for robot in self._robots.values():
            robot.end("finished")
        self._robots.clear()

    def _names_taken(self) -> set[str]:
        """Return the names of the robots of this simulation that other processes record."""
        own = {robot.session_id for robot in self._robots.values()}
        instance, now_s = self._observer.identity.instance, time.time()
        statement = (
            "SELECT r.name, s.id, s.instance, s.host, s.pid, s.process, s.last_seen_wall_time_s "
            "FROM session s JOIN robot r ON r.id = s.robot_id WHERE s.ended_wall_time_s IS NULL"
        )
        rows = self._observer.recorder.fetch(statement, ())
        if rows is None:
            return self._taken
        checked_s = time.monotonic()
        for name, session_id, recorded_in, host, pid, process, seen_s in rows:
            if (
                session_id not in own
                and same_simulation(recorded_in, instance)
                and is_living(host, pid, process, seen_s, now_s)
            ):
                self._taken_at_s[name] = checked_s
        # A bridge that has just ended is often the first of a simulation that ends as a whole.
        return {
            name for name, at_s in self._taken_at_s.items() if checked_s - at_s < _LIMITS.rest_s
        }


class _Robot:
    """One robot, its field, and its recording once it has written something.

    Attributes:
        body: What the observer follows.
    """

    def __init__(self, body: SeenRobot, observer: ObserverParts) -> None:
        self.body = body
        self._observer = observer
        self._field: Any = None  # None without such a field, or once the node was removed
        self._is_searched = False
        self._recording: _Recording | None = None
        self._text = self._text_left = ""  # newest; written while another recorded
        self._read_again_s: float | None = None  # None while Webots sends the field with each step

    @property
    def session_id(self) -> int | None:
        """The session of its recording; None without one."""
        registration = self._recording and self._recording.recorder.registration
        return registration.session_id if registration else None

    def read(self, now_s: float, *, is_due: bool, is_taken: bool) -> bool:
        """Read the field and record its text, if there is a recording.

        Args:
            now_s: The time of the monotonic clock.
            is_due: Also record a text that is not new.
            is_taken: Another process records this robot.

        Returns:
            Whether there is a text to record and no session yet.
        """
        if not self._is_searched:  # a value read in this round would be newer than the last step
            self._find_field()
            return False
        if self._field is None:
            return False
        if not self.body.is_there:
            self._field = None
            self.end("finished")
            return False
        before, self._text = self._text, self._read_text(now_s)
        if is_taken:
            self.end("superseded")
            self._text_left = self._text
            return False
        if self._recording is None:
            return self._text not in ("", self._text_left)
        self._recording.record(self._text, is_new=self._text != before, is_due=is_due)
        return False

    def begin(self) -> None:
        """Begin its session with the text that it has written."""
        self.body.scene.node.enablePoseTracking(
            self._step_ms
        )  # so that each text gets the pose of its step
        self._recording = _Recording(self.body, self._observer)
        self._recording.record(self._text, is_new=True, is_due=True)

    def end(self, reason: str) -> None:
        """End its session, because the robot ends or another process records it now."""
        if self._recording is not None:
            self._recording.end(reason)
            self._recording = None

    @property
    def _step_ms(self) -> int:
        return max(int(1000 * self._observer.simulation.basic_time_step_s), 1)

    def _find_field(self) -> None:
        self._is_searched = True
        self._field = find_field(self.body.scene.node, CUSTOM_DATA)
        if self._field is None:
            why = f"the PROTO of robot {self.body.name!r} hides its customData: it cannot be read"
            self._observer.journal.log("info", "bridge", why)
        else:
            self._field.enableSFTracking(self._step_ms)

    def _read_text(self, now_s: float) -> str:
        """Read the text of the field; a long one is read once a second, not sent with steps."""
        if self._read_again_s is not None and now_s < self._read_again_s:
            return self._text
        try:
            text: str = self._field.getSFString()
        except UnicodeDecodeError as error:  # Webots passes on whatever bytes a robot wrote
            text = error.object.decode("utf-8", "replace")
        is_long = len(text) > LONGEST_TEXT
        if is_long and self._read_again_s is None:
            self._field.disableSFTracking()
        elif not is_long and self._read_again_s is not None:
            self._field.enableSFTracking(self._step_ms)
        self._read_again_s = now_s + _LIMITS.long_text_s if is_long else None
        return "" if _OF_CAR.match(text) else text


class _Recording:
    """Writes the session of one robot."""

    def __init__(self, body: SeenRobot, observer: ObserverParts) -> None:
        identity = observer.identity._replace(
            robot_name=recorded_name(body.name or "robot"),
            kind=CUSTOM_DATA,
            supervisor=False,
            devices={},
            controller=body.controller or None,
            controller_sha256=None,
            git_commit=None,
            versions={"observer": observer.identity.versions["webots_mcp"]},
        )
        self._body = body
        self._followed, self._observed_run = observer.clock, observer.clock.run
        self._clock = Clock(observer.simulation)
        self._clock.meter = LoopMeter()  # the robot's own loop cannot be seen
        self._errors = ErrorReport(strict=False)
        self.recorder = Recorder(observer.recorder.database, identity, self._clock, self._errors)
        self._journal = Journal(self.recorder, self._clock)
        self._heartbeat = Heartbeat(self.recorder, self._clock)
        self._names, self._changes = SignalNames(), StateChanges()
        self._values: Mapping[str, Any] = {}
        self._stale_until_s = -1.0
        self._delay_s = _LIMITS.delay_steps * observer.simulation.basic_time_step_s
        self._sequence = _Sequence()
        registration = self.recorder.registration
        if registration is not None and registration.reloaded:
            self._clock.run.start_reason = "reload"
        self._journal.event(self._clock.run.start_reason)

    def record(self, text: str, *, is_new: bool, is_due: bool) -> None:
        """Record a text that is new, or, if a row is due, one that was recorded before."""
        if self._clock.follow(self._followed, self._observed_run):
            self._begin_run()
        if is_new:
            self._values = signals_of(text)
        if is_new and not self._may_be_of_former_run:
            self._stale_until_s = -1.0
            if self._sequence.count(self._values.get("seq")):
                self._report_missed()
        if is_new or is_due:
            self._record()
        self._heartbeat.beat_if_due()

    def end(self, reason: str) -> None:
        """End run and session; a session that a bridge has ended keeps its reason."""
        ids = self.recorder.registration
        statement = "SELECT end_reason FROM session WHERE id = ?"
        for (ended,) in (ids and self.recorder.fetch(statement, (ids.session_id,))) or ():
            reason = ended or reason
        self.recorder.close(reason, self._clock.sim_time_s)

    @property
    def _may_be_of_former_run(self) -> bool:
        """Whether a new text may have been sent before the world was reset."""
        was_reset = self._stale_until_s >= 0.0
        return was_reset and self._clock.sim_time_s < self._delay_s + _LIMITS.epsilon_s

    def _begin_run(self) -> None:
        """Begin a run after a reset; the field still holds the text from before it."""
        self._observed_run = self._followed.run
        self.recorder.end_run("reset", self._clock.ended_sim_time_s)
        self.recorder.run = self._clock.run
        self._sequence = _Sequence()
        self._changes.forget()
        self._stale_until_s = self._clock.sim_time_s + _LIMITS.stale_s
        self._journal.event("reset")

    def _record(self) -> None:
        """Record the newest values with the pose of the robot."""
        is_stale = self._clock.sim_time_s < self._stale_until_s
        state = dict({} if is_stale else self._values)
        pose = self._body.pose_now() or {}
        own = pose.keys() & state.keys()
        moved = pose.keys() if own & _PLACE else own
        state |= {name: value for name, value in pose.items() if name not in moved}
        if moved:
            state[SEEN] = {name: value for name, value in pose.items() if name in moved}
        if self._sequence.last is not None:
            state.setdefault(MISSED, self._sequence.missed)
        encoded = encode(state)
        self._journal.state(encoded)
        for name, before, after in self._changes.compare(state):
            self._journal.event("change", {"from": before, "to": after}, name)
        self._names.register(state, encoded.text, self.recorder.enter_signals)

    def _report_missed(self) -> None:
        """Report that the robot overwrites messages before they are read."""
        counted = self._sequence
        self._journal.event("missed", {"messages": counted.missed, "of": counted.total})
        self._errors.warn(  # also shown by status, as its newest error
            "missed",
            f"robot {self._body.name!r} overwrote {counted.missed} of {counted.total} messages in "
            "its customData before the observer read them (seq): "
            "see 'webots-mcp help any-language rates'",
        )
        self._heartbeat.beat()


class _Sequence:
    """Counts missed messages by the key `seq`, which a robot raises by 1 with each message.

    Attributes:
        last: The newest number; None before the first.
        missed: Number of messages that were overwritten before they were read.
        total: Number of messages, read or missed.
    """

    def __init__(self) -> None:
        self.last: int | None = None
        self.missed = self.total = 0
        self._report_from = 1

    def count(self, given: object) -> bool:
        """Count a message; a number that is not above the last one begins a new count.

        Returns:
            Whether the number of missed messages has doubled since it was last reported.
        """
        if isinstance(given, float) and given.is_integer():  # 12.0, as some languages write it
            given = int(given)
        if type(given) is not int:
            return False
        skipped = given - self.last - 1 if self.last is not None and given > self.last else 0
        before, self.last = self.last, given
        self.missed += skipped
        self.total += skipped + (given != before)
        if self.missed < self._report_from:
            return False
        self._report_from = 2 * self.missed
        return True
