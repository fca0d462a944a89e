"""The state of the controller library: what it received, and what it has yet to send."""

from __future__ import annotations

import os
import threading
from typing import Any, Final, NoReturn, Protocol

from .console import say
from .wire import Message

CUSTOM_DATA_TAG: Final = 0
"""Stands for the robot itself where devices have their tags."""
PoseKey = tuple[int, int | None]
"""The ids of a node and of the one that it is seen from; None is the world."""


class Link(Protocol):
    """A connection to a simulator, through a socket or within one process."""

    description: dict[str, Any]
    """The data about the robot and its devices from the simulator."""

    def send(self, message: Message) -> None:
        """Send a request."""
        ...

    def receive(self) -> Message:
        """Wait for an answer."""
        ...

    def exit(self) -> NoReturn:
        """What a request after the end of the simulation comes to."""
        ...

    def close(self) -> None:
        """Say farewell."""
        ...


class Session:
    """What the library knows between two requests.

    As in the real library one recursive lock guards it, held during the whole of `step`: other
    threads that want a sensor value or a request wait until the step is over.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.robot: dict[str, Any] = link.description
        self.time_s: float = self.robot["time"]
        self.mode: int = self.robot["mode"]
        self.custom_data: str = self.robot["custom_data"]
        self.periods_ms: dict[int, int] = {}
        """Sampling periods by device tag; a device without one is disabled."""
        self.lock = threading.RLock()
        self._values: dict[Any, Any] = {}
        self._changes: dict[tuple[Any, str], Any] = {}
        self.counts: dict[tuple[int, str], int] = {}
        """The number of entries of each field that was asked for, by node and name."""
        self._tracked: set[PoseKey] = set()
        self._field_sets: dict[Any, Any] = {}
        self._fetched: dict[int, tuple[Any, Any]] = {}
        self._stepped: Message | None = None
        self._in_step = False
        self._quitting = False
        self._ended = False

    # Between requests ----------------------------------------------------------------------------

    def change(self, tag: int, setting: str, value: Any) -> None:
        """Note a setting or a command that goes out with the next step."""
        with self.lock:
            self._changes[tag, setting] = value

    def set_custom_data(self, data: str) -> None:
        """Like `change`, but without the lock: this does not wait for a step to end."""
        self.custom_data = self._changes[CUSTOM_DATA_TAG, "customData"] = data

    def enable(self, tag: int, period_ms: int) -> None:
        """Set a sampling period; 0 disables."""
        self.change(tag, "period", period_ms)
        self.periods_ms[tag] = period_ms

    def track(self, pose: PoseKey, period_ms: int) -> None:
        """Have a pose sent with the steps, once in a period; 0 ends that."""
        with self.lock:
            self._changes[pose, "track"] = period_ms
            self._values.pop(pose, None)
            (self._tracked.add if period_ms else self._tracked.discard)(pose)

    def tracked(self, pose: PoseKey) -> Any:
        """A tracked pose as it came last; None where it has to be asked for."""
        with self.lock:
            return self._values.get(pose) if pose in self._tracked else None

    def value(self, tag: int, default: Any) -> Any:
        """The last value of a sensor."""
        with self.lock:
            return self._values.get(tag, default)

    def set_field(self, field: tuple[int, str], index: int | None, value: Any) -> None:
        """Note a field change that goes out with the next step or field read."""
        with self.lock:
            self._field_sets[field, index] = value

    # Requests ------------------------------------------------------------------------------------

    def begin_step(self, duration_ms: int) -> None:
        """Ask the simulator to let time pass."""
        with self.lock:
            self._exit_if_over()
            if self._quitting:
                return
            changes = [(*key, value) for key, value in self._changes.items()]
            self._changes.clear()
            self.link.send(("step", duration_ms & 0xFFFFFFFF, changes, self._take_field_sets()))
            self._in_step = True

    def end_step(self) -> int:
        """Wait until that time has passed; -1 if the simulator ends the controller."""
        with self.lock:
            reply: Message = ("quit",) if self._quitting else self._stepped or self.link.receive()
            self._stepped, self._in_step = None, False
            if reply[0] == "quit":
                self._quitting = self._ended = True
                return -1
            _, self.time_s, self.mode, delay_ms, values = reply
            self._values.update(values)
            self.custom_data = self._values.pop(CUSTOM_DATA_TAG, self.custom_data)
            return delay_ms

    def step(self, duration_ms: int) -> int:
        """Both halves of a step, without another thread in between."""
        with self.lock:
            self.begin_step(duration_ms)
            try:
                return self.end_step()
            finally:
                self._in_step = False

    def ask(self, operation: str, *arguments: Any, default: Any = None) -> Any:
        """Make a request that is answered at once, also while the simulation is paused."""
        return self._ask(operation, arguments, [], default)

    def read_field(self, field: tuple[int, str], index: int | None) -> Any:
        """Read a field; changes that were not sent yet go first."""
        with self.lock:
            if (field, index) in self._field_sets:
                return self._field_sets[field, index]
            return self._ask("field_get", (field, index), self._take_field_sets(), None)

    def change_field(self, operation: str, field: tuple[int, str], *arguments: Any) -> Any:
        """Add or remove entries at once; changes that were not sent yet go first."""
        with self.lock:
            return self._ask(operation, (field, *arguments), self._take_field_sets(), None)

    def fetch(self, tag: int) -> Any:
        """The picture or scan that belongs to a sensor's last sample; None before the first."""
        with self.lock:
            sample = self._values.get(tag)
            known = self._fetched.get(tag)
            if sample is None or (known and known[0] == sample) or self._quitting:
                return known[1] if known else None
            self.link.send(("fetch", tag))
            reply = self.link.receive()
            if reply[0] == "stepped":  # the answer to a step that was begun came first
                self._stepped, reply = reply, self.link.receive()
            if reply[0] == "quit":
                self._quitting = True
                return None
            self._fetched[tag] = (sample, reply[1])
            return reply[1]

    def _ask(self, operation: str, arguments: Any, field_sets: list[Any], default: Any) -> Any:
        with self.lock:
            self._exit_if_over()
            if self._quitting or not self._may_ask(f"wb_supervisor_{operation}()"):
                return default
            self.link.send(("ask", operation, [*arguments], field_sets))
            reply = self.link.receive()
            if reply[0] == "quit":
                self._quitting = True
                return default
            _, value, self.mode = reply
            return default if value is None else value

    def _may_ask(self, function: str) -> bool:
        if not self.robot["supervisor"]:
            say(f"Error: ignoring illegal call to {function} in a 'Robot' controller.")
            say("Error: this function can only be used in a 'Supervisor' controller.")
        elif self._in_step:
            say(
                f"Warning: {function} called between wb_robot_step_begin() and wb_robot_step_end()."
            )
        return self.robot["supervisor"] and not self._in_step

    def _take_field_sets(self) -> list[Any]:
        taken = [(field, index, value) for (field, index), value in self._field_sets.items()]
        self._field_sets.clear()
        return taken

    def _exit_if_over(self) -> None:
        if self._ended:
            self.link.exit()


current: Session | None = None
"""The session of the process's one robot; devices made by name belong to it."""


def exit_process(status: int) -> NoReturn:
    """End the process as C `exit` ends it: no exception, no `finally`, no atexit, no flush."""
    os._exit(status)
