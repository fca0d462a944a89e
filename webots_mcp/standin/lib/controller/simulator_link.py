"""The connection of a controller to the simulator, and what the library knows between requests.

A message is a length and a marshalled value: `marshal` rather than JSON because pictures are bytes
and ranges are hundreds of floats, version 2 because every Python 3 reads it. It is read only from a
peer that has presented the simulation's token.
"""

from __future__ import annotations

import marshal
import os
import socket
import struct
import threading
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, NoReturn, Protocol, TypeAlias

from .surface import say

Message: TypeAlias = tuple[Any, ...]
NodeFacts: TypeAlias = tuple[int, str, str, str, int]
"""A node: id, type, base type, DEF name and the id of its parent."""
FieldKey: TypeAlias = tuple[int, str]
"""A field: the id of its node and its name."""

ADDRESS_FILE: Final = "address"
"""File in the instance folder that holds the port on this machine, a space and the token."""

_LENGTH: Final = struct.Struct("!I")
CUSTOM_DATA_TAG: Final = 0
"""Tag of the robot itself among the tags of its devices."""
TrackedKey = tuple[int, int | str | None]
"""A field: node id and name. A pose: node id and the id it is seen from, None for the world."""


def pack(message: Message) -> bytes:
    """Return a message as bytes."""
    body = marshal.dumps(message, 2)
    return _LENGTH.pack(len(body)) + body


class Inbox:
    """Assembles messages from the bytes that arrive."""

    def __init__(self) -> None:
        self._arrived = bytearray()

    def feed(self, data: bytes) -> None:
        """Add bytes from the socket."""
        self._arrived += data

    def take(self) -> Message | None:
        """Return the next complete message; None if it has not arrived yet."""
        if len(self._arrived) < _LENGTH.size:
            return None
        end = _LENGTH.size + _LENGTH.unpack_from(self._arrived)[0]
        if len(self._arrived) < end:
            return None
        message = marshal.loads(self._arrived[_LENGTH.size : end])
        del self._arrived[:end]
        return message


def connect(port: int) -> socket.socket:
    """Connect to the simulator on this machine."""
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


class SimulatorLink(Protocol):
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
        """End the controller, which made a request after the end of the simulation."""
        ...

    def close(self) -> None:
        """Disconnect."""
        ...


def exit_process(status: int) -> NoReturn:
    """End the process like C `exit`: no exception, no `finally`, no atexit, no flush."""
    os._exit(status)


class SocketLink:
    """A socket to the simulator that the `WEBOTS_...` environment variables name."""

    def __init__(self) -> None:
        port, token, robot_name = _address()
        self._socket = connect(port)
        self._inbox = Inbox()
        self.send(("hello", token, robot_name))
        kind, answer = self.receive()
        if kind != "welcome":
            raise ConnectionRefusedError(f"the simulation refused this controller: {answer}")
        self.description: dict[str, Any] = answer

    def send(self, message: Message) -> None:
        """Send a request. If the simulator has ended, end this process."""
        try:
            self._socket.sendall(pack(message))
        except OSError:
            exit_process(1)

    def receive(self) -> Message:
        """Wait for an answer. If the simulator ends meanwhile, end this process."""
        while (message := self._inbox.take()) is None:
            try:
                data = self._socket.recv(1 << 20)
            except OSError:
                data = b""
            if not data:
                exit_process(1)
            self._inbox.feed(data)
        return message

    def exit(self) -> NoReturn:
        """End the process: the API was used after the end."""
        exit_process(0)

    def close(self) -> None:
        """Disconnect: this controller has finished."""
        self._socket.close()


def _address() -> tuple[int, str, str]:
    """Return port, token and robot name, searched in the order of the real library."""
    name, folder = os.environ.get("WEBOTS_ROBOT_NAME"), os.environ.get("WEBOTS_INSTANCE_PATH")
    if name and folder:
        port, token = (Path(folder) / ADDRESS_FILE).read_text(encoding="utf-8").split()
        return int(port), token, name
    if url := os.environ.get("WEBOTS_CONTROLLER_URL"):
        place, _, name = url.partition("://")[2].partition("/")
        return int(place.rpartition(":")[2]), os.environ.get("WEBOTS_STANDIN_TOKEN", ""), name
    raise ConnectionError(
        "no simulation has started this process. Run the controller from a world: "
        "python -m webots_mcp.standin WORLD; in a test use webots_mcp.standin.InProcessRobot"
    )


class SentPackets:
    """The packets that a controller has sent by an emitter, until the next step takes them.

    As in Webots, channel and range of a packet are those at the moment it was sent.
    """

    def __init__(self, fields: dict[str, Any]) -> None:
        self._fields = fields
        self._packets: deque[tuple[bytes, int, float]] = deque()
        self._bytes_due = 0.0

    def put(self, packet: bytes) -> None:
        """Queue a packet, unless the emitter's buffer is full."""
        used = sum(len(queued) for queued, *_ in self._packets)
        if not 0 <= self._fields["bufferSize"] < used + len(packet):
            self._bytes_due = self._bytes_due if self._packets else 0.0
            self._packets.append((packet, self._fields["channel"], self._fields["range"]))

    def take(self, duration_ms: int) -> list[tuple[bytes, int, float]]:
        """Take the packets that the baud rate lets through in a step of this duration."""
        taken: list[tuple[bytes, int, float]] = []
        is_limited = self._fields["baudRate"] >= 0
        if self._packets and is_limited:
            self._bytes_due += (
                self._fields["baudRate"] / max(self._fields["byteSize"], 8) / 1000.0 * duration_ms
            )
        while self._packets and not (is_limited and len(self._packets[0][0]) > self._bytes_due):
            taken.append(self._packets.popleft())
            self._bytes_due -= len(taken[-1][0])
        return taken


class ReceivedPackets(deque[Any]):
    """Bytes, direction and strength of each packet of a receiver, the oldest first."""

    def __init__(self, fields: dict[str, Any]) -> None:
        super().__init__()
        self._fields = fields

    def put(self, packets: Iterable[Any]) -> None:
        """Queue packets. If the receiver's buffer is full, further packets are lost."""
        for packet in packets:
            used = sum(len(queued) for queued, *_ in self)
            if not 0 <= self._fields["bufferSize"] < used + len(packet[0]):
                self.append(packet)


class ControllerSession:
    """The state of the library between two requests.

    As in the real library, one recursive lock guards it and is held during the whole of `step`.
    Other threads that read a sensor value or make a request wait until the step is over.
    """

    def __init__(self, link: SimulatorLink) -> None:
        self.link = link
        self.robot: dict[str, Any] = link.description
        self.time_s: float = self.robot["time"]
        self.mode: int = self.robot["mode"]
        self.custom_data: str = self.robot["custom_data"]
        self.periods_ms: dict[int, int] = {}
        """Sampling periods by device tag. A device without one is disabled."""
        self.lock = threading.RLock()
        self._values: dict[Any, Any] = {}
        self._changes: dict[tuple[Any, str], Any] = {}
        devices: list[dict[str, Any]] = self.robot["devices"]
        fields = {(device["node_type"], device["tag"]): device["fields"] for device in devices}
        self.sent = {
            tag: SentPackets(of) for (kind, tag), of in fields.items() if kind == "Emitter"
        }
        """Packets that wait to be sent, by tag of the emitter."""
        self.received = {
            tag: ReceivedPackets(of) for (kind, tag), of in fields.items() if kind == "Receiver"
        }
        """Packets that have arrived, by tag of the receiver."""
        self.counts: dict[FieldKey, int] = {}
        """Number of entries of each field that was requested."""
        self._nodes: dict[int, NodeFacts] = {}
        for node in (self.robot["root"], self.robot["self"]):
            self.know(node)
        self._fields: dict[tuple[str, FieldKey], str] = {}
        self._field_names: dict[tuple[int, int], str | None] = {}
        self._reads: dict[FieldKey, tuple[float, Any]] = {}
        self._kept: dict[Any, Any] = {}
        self._tracked: set[TrackedKey] = set()
        self._field_sets: dict[Any, Any] = {}
        self._fetched: dict[int, tuple[Any, Any]] = {}
        self._stepped: Message | None = None
        self._in_step = False
        self._quitting = False
        self._ended = False

    # Between requests ----------------------------------------------------------------------------

    def change(self, tag: int, setting: str, value: Any) -> None:
        """Store a setting or command, which is sent with the next step."""
        with self.lock:
            self._changes[tag, setting] = value

    def set_custom_data(self, data: str) -> None:
        """Set the custom data without the lock, so that it does not wait for a step to end."""
        self.custom_data = self._changes[CUSTOM_DATA_TAG, "customData"] = data

    def enable(self, tag: int, period_ms: int) -> None:
        """Set a sampling period; 0 disables."""
        self.change(tag, "period", period_ms)
        self.periods_ms[tag] = period_ms

    def track(self, what: TrackedKey, period_ms: int) -> None:
        """Request a pose or field with the steps, once a period; 0 ends that."""
        with self.lock:
            self._changes[what, "track"] = period_ms
            self._values.pop(what, None)
            (self._tracked.add if period_ms else self._tracked.discard)(what)

    def tracked(self, what: TrackedKey) -> Any:
        """Return the last value of a tracked pose or field; None if it has to be requested."""
        with self.lock:
            return self._values.get(what) if what in self._tracked else None

    def value(self, tag: int, default: Any) -> Any:
        """Return the last value of a sensor."""
        with self.lock:
            return self._values.get(tag, default)

    def set_field(self, field: tuple[int, str], index: int | None, value: Any) -> None:
        """Store a field change, which is sent with the next step or field read."""
        with self.lock:
            self._field_sets[field, index] = value
            self._values.pop(field, None)

    # Requests ------------------------------------------------------------------------------------

    def begin_step(self, duration_ms: int) -> int:
        """Request that time passes; return 0, or -1 if the simulator has ended the controller."""
        with self.lock:
            self._exit_if_over()
            if self._quitting:
                return -1
            changes = [(*key, value) for key, value in self._changes.items()]
            for tag, packets in self.sent.items():
                changes.extend((tag, "send", packet) for packet in packets.take(duration_ms))
            self._changes.clear()
            self.link.send(("step", duration_ms & 0xFFFFFFFF, changes, self._take_field_sets()))
            self._in_step = True
            return 0

    def end_step(self) -> int:
        """Wait until the time has passed; return -1 if the simulator ends the controller."""
        with self.lock:
            reply: Message = ("quit",) if self._quitting else self._stepped or self.link.receive()
            self._stepped, self._in_step = None, False
            if reply[0] == "quit":
                self._quitting = self._ended = True
                return -1
            _, self.time_s, self.mode, delay_ms, values = reply
            self._values.update(values)
            for tag, queue in self.received.items():
                queue.put(self._values.pop(tag, ()))
            self.custom_data = self._values.pop(CUSTOM_DATA_TAG, self.custom_data)
            return delay_ms

    def step(self, duration_ms: int) -> int:
        """Do both halves of a step, with no other thread in between."""
        with self.lock:
            self.begin_step(duration_ms)
            try:
                return self.end_step()
            finally:
                self._in_step = False

    # Once the simulator has ended the controller, no request is answered any more. As in Webots' C
    # library, each getter returns its last value until `step` has returned -1. After that, only
    # getters that need no request return their values; all others end the process.

    @property
    def is_quitting(self) -> bool:
        """Return whether the simulator has ended the controller: the next step returns -1."""
        return self._quitting

    def ask(self, operation: str, *arguments: Any, kept_as: Any = None, default: Any = None) -> Any:
        """Make a request that is answered at once, also while the simulation is paused.

        Args:
            operation: The name of the request.
            arguments: Arguments of the request.
            kept_as: Key under which the answer is stored for the end; None to store nothing.
            default: Returned if there is no answer.
        """
        with self.lock:
            answer = self._ask(operation, arguments, [])
            if kept_as is not None and self._quitting:
                answer = self._kept.get(kept_as)
            elif kept_as is not None and answer is not None:
                self._kept[kept_as] = answer
            return default if answer is None else answer

    def answer_locally(self, what: Any, value: Any) -> Any:
        """Return a known value that Webots' library would request; at the end the last one."""
        with self.lock:
            self._exit_if_over()
            if not self._quitting:
                self._kept[what] = value
            return self._kept.get(what)

    def know(self, node: NodeFacts) -> None:
        """Store a node that the simulator has described."""
        self._nodes[node[0]] = node

    def forget(self, node_id: int) -> None:
        """Forget a node that was removed."""
        self._nodes.pop(node_id, None)

    def find_node(
        self, operation: str, argument: Any, matches: Callable[[NodeFacts], bool]
    ) -> NodeFacts | None:
        """Request a node; at the end search the known nodes."""
        with self.lock:
            if not self._quitting:
                found = self._ask(operation, (argument,), [])
                if not self._quitting:
                    if found is None and not self._in_step:
                        self._nodes = {n[0]: n for n in self._nodes.values() if not matches(n)}
                    return found
            known = next((node for node in reversed(self._nodes.values()) if matches(node)), None)
            if known is None:
                self._exit_if_over()
            return known

    def find_field(self, operation: str, key: FieldKey) -> tuple[FieldKey, str, int] | None:
        """Request a field: its key, its type and the number of its entries.

        As in Webots, at the end an unknown field is the field that was found last.
        """
        with self.lock:
            if not self._quitting:
                found = self._ask(operation, key, [])
                if not self._quitting:
                    if found is not None:
                        self._fields.setdefault((operation, key), found[0])
                    return None if found is None else (key, *found)
            known = (operation, key)
            if known not in self._fields:
                self._exit_if_over()
                known = next(reversed(self._fields), None)
            return known and (known[1], self._fields[known], self.counts[known[1]])

    def find_field_name(self, node_id: int, index: int) -> str | None:
        """Return the name of a field by its index; at the end only if it was requested before."""
        with self.lock:
            if not self._quitting:
                names: list[str] = self._ask("node_get_field_names", (node_id,), []) or []
                if not self._quitting:
                    name = names[index] if 0 <= index < len(names) else None
                    self._field_names[node_id, index] = name
                    return name
            name = self._field_names.get((node_id, index))
            if name is None:
                self._exit_if_over()
            return name

    def read_field(self, field: FieldKey, index: int | None, unread: Any) -> Any:
        """Read a field, after sending the changes that wait.

        Args:
            field: The field.
            index: Index of the entry; None for a single field.
            unread: Returned at the end for a field that was not read before.
        """
        with self.lock:
            read_s, last = self._reads.get(field, (-1.0, unread))
            if (field, index) in self._field_sets:
                value = self._field_sets[field, index]
                self._reads[field] = (read_s, value)
                return value
            if index is None and (tracked := self.tracked(field)) is not None:
                return tracked
            if self._quitting and index is None and read_s == self.time_s:
                return last
            value = self._ask("field_get", (field, index), self._take_field_sets())
            if self._quitting:
                return last
            if not self._in_step:
                self._reads[field] = (self.time_s, value)
            return value

    def change_field(self, operation: str, field: tuple[int, str], *arguments: Any) -> Any:
        """Add or remove entries at once, after sending the changes that wait."""
        with self.lock:
            return self._ask(operation, (field, *arguments), self._take_field_sets())

    def fetch(self, tag: int) -> Any:
        """Return the picture or scan of a sensor's last sample; None before the first.

        The simulator also sends it while it ends the controller.
        """
        with self.lock:
            sample = self._values.get(tag)
            known = self._fetched.get(tag)
            if sample is None or (known and known[0] == sample):
                return known[1] if known else None
            self.link.send(("fetch", tag))
            while (reply := self.link.receive())[0] != "fetched":
                if self._in_step:  # The answer to a begun step came first.
                    self._stepped = reply
                else:
                    self._quitting = True
            self._fetched[tag] = (sample, reply[1])
            return reply[1]

    def _ask(self, operation: str, arguments: Any, field_sets: list[Any]) -> Any:
        with self.lock:
            self._exit_if_over()
            if self._quitting or not self._may_ask(f"wb_supervisor_{operation}()"):
                return None
            self.link.send(("ask", operation, [*arguments], field_sets))
            reply = self.link.receive()
            if reply[0] == "quit":
                self._quitting = True
                return None
            _, value, self.mode = reply
            return value

    def is_supervisor(self, function: str) -> bool:
        """Return whether the robot has a supervisor's rights; print an error if it lacks them."""
        if not self.robot["supervisor"]:
            say(f"Error: ignoring illegal call to {function} in a 'Robot' controller.")
            say("Error: this function can only be used in a 'Supervisor' controller.")
        return self.robot["supervisor"]

    def _may_ask(self, function: str) -> bool:
        if not self.is_supervisor(function):
            return False
        if self._in_step:
            say(
                f"Warning: {function} called between wb_robot_step_begin() and wb_robot_step_end()."
            )
        return not self._in_step

    def _take_field_sets(self) -> list[Any]:
        taken = [(field, index, value) for (field, index), value in self._field_sets.items()]
        self._field_sets.clear()
        return taken

    def _exit_if_over(self) -> None:
        if self._ended:
            self.link.exit()


current: ControllerSession | None = None
"""Session of the process's only robot. Devices that are made by name belong to it."""
