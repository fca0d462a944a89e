"""How a controller talks to the simulator: messages, the socket, and what it knows meanwhile.

A message is a length and a marshalled value. `marshal` rather than JSON because pictures are bytes
and ranges are hundreds of floats; version 2 because every Python 3 reads it. It is read only from a
peer that has shown the simulation's token.
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
"""What is known of a node: id, type, base type, DEF name and id of the node around it."""
FieldKey: TypeAlias = tuple[int, str]
"""The id of a node and the name of its field."""

ADDRESS_FILE: Final = "address"
"""File in the instance folder: the port on this machine, a space, the token."""

_LENGTH: Final = struct.Struct("!I")
CUSTOM_DATA_TAG: Final = 0
"""Stands for the robot itself where devices have their tags."""
TrackedKey = tuple[int, int | str | None]
"""The ids of a node and of the one that it is seen from; None is the world."""


def pack(message: Message) -> bytes:
    """A message as it goes over the wire."""
    body = marshal.dumps(message, 2)
    return _LENGTH.pack(len(body)) + body


class Inbox:
    """Puts messages together from what arrives."""

    def __init__(self) -> None:
        self._arrived = bytearray()

    def feed(self, data: bytes) -> None:
        """Take what the socket gave."""
        self._arrived += data

    def take(self) -> Message | None:
        """The next whole message; None if it has not arrived yet."""
        if len(self._arrived) < _LENGTH.size:
            return None
        end = _LENGTH.size + _LENGTH.unpack_from(self._arrived)[0]
        if len(self._arrived) < end:
            return None
        message = marshal.loads(self._arrived[_LENGTH.size : end])
        del self._arrived[:end]
        return message


def connect(port: int) -> socket.socket:
    """A connection to the simulator on this machine."""
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
        """What a request after the end of the simulation comes to."""
        ...

    def close(self) -> None:
        """Say farewell."""
        ...


def exit_process(status: int) -> NoReturn:
    """End the process as C `exit` ends it: no exception, no `finally`, no atexit, no flush."""
    os._exit(status)


class SocketLink:
    """Talks to the simulator that the `WEBOTS_...` environment variables name."""

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
        """Send a request; if the simulator is gone, so is this process."""
        try:
            self._socket.sendall(pack(message))
        except OSError:
            exit_process(1)

    def receive(self) -> Message:
        """Wait for an answer; if the simulator goes away meanwhile, so does this process."""
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
        """The API was used after the end."""
        exit_process(0)

    def close(self) -> None:
        """Let the simulator know that this controller is done."""
        self._socket.close()


def _address() -> tuple[int, str, str]:
    """Port, token and robot name; the real library looks in this order, too."""
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
    """The packets of an emitter that its controller has sent, until a step takes them along.

    As in Webots, the channel and the range of a packet are those at the moment when it was sent.
    """

    def __init__(self, fields: dict[str, Any]) -> None:
        self._fields = fields
        self._packets: deque[tuple[bytes, int, float]] = deque()
        self._bytes_due = 0.0

    def put(self, packet: bytes) -> None:
        """Queue a packet, unless the emitter's buffer has no space for it."""
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
    """Bytes, direction and strength of each packet that a receiver has, the oldest first."""

    def __init__(self, fields: dict[str, Any]) -> None:
        super().__init__()
        self._fields = fields

    def put(self, packets: Iterable[Any]) -> None:
        """Queue packets; those for which the receiver's buffer has no space are lost."""
        for packet in packets:
            used = sum(len(queued) for queued, *_ in self)
            if not 0 <= self._fields["bufferSize"] < used + len(packet[0]):
                self.append(packet)


class ControllerSession:
    """What the library knows between two requests.

    As in the real library one recursive lock guards it, held during the whole of `step`: other
    threads that want a sensor value or a request wait until the step is over.
    """

    def __init__(self, link: SimulatorLink) -> None:
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
        devices: list[dict[str, Any]] = self.robot["devices"]
        fields = {(device["node_type"], device["tag"]): device["fields"] for device in devices}
        self.sent = {
            tag: SentPackets(of) for (kind, tag), of in fields.items() if kind == "Emitter"
        }
        """What emitters are still to send, by tag."""
        self.received = {
            tag: ReceivedPackets(of) for (kind, tag), of in fields.items() if kind == "Receiver"
        }
        """What receivers have, by tag."""
        self.counts: dict[FieldKey, int] = {}
        """The number of entries of each field that was asked for, by node and name."""
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

    def track(self, what: TrackedKey, period_ms: int) -> None:
        """Have a pose or field sent with the steps, once in a period; 0 ends that."""
        with self.lock:
            self._changes[what, "track"] = period_ms
            self._values.pop(what, None)
            (self._tracked.add if period_ms else self._tracked.discard)(what)

    def tracked(self, what: TrackedKey) -> Any:
        """What is tracked as it came last; None where it has to be asked for."""
        with self.lock:
            return self._values.get(what) if what in self._tracked else None

    def value(self, tag: int, default: Any) -> Any:
        """The last value of a sensor."""
        with self.lock:
            return self._values.get(tag, default)

    def set_field(self, field: tuple[int, str], index: int | None, value: Any) -> None:
        """Note a field change that goes out with the next step or field read."""
        with self.lock:
            self._field_sets[field, index] = value
            self._values.pop(field, None)

    # Requests ------------------------------------------------------------------------------------

    def begin_step(self, duration_ms: int) -> int:
        """Ask the simulator to let time pass: 0, or -1 if it has ended the controller."""
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
        """Wait until that time has passed; -1 if the simulator ends the controller."""
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
        """Both halves of a step, without another thread in between."""
        with self.lock:
            self.begin_step(duration_ms)
            try:
                return self.end_step()
            finally:
                self._in_step = False

    # Once the simulator has ended the controller, nothing can be asked any more. As in Webots' C
    # library, until `step` has returned -1 each getter gives what it gave before; after that only
    # those that make no request for what they know, and the others end the process.

    @property
    def is_quitting(self) -> bool:
        """Whether the simulator has ended the controller: the next step returns -1, or one has."""
        return self._quitting

    def ask(self, operation: str, *arguments: Any, kept_as: Any = None, default: Any = None) -> Any:
        """Make a request that is answered at once, also while the simulation is paused.

        Args:
            operation: The name of the request.
            arguments: What it needs.
            kept_as: Under what the answer is remembered for the end; None: it is not.
            default: What is returned where there is no answer.
        """
        with self.lock:
            answer = self._ask(operation, arguments, [])
            if kept_as is not None and self._quitting:
                answer = self._kept.get(kept_as)
            elif kept_as is not None and answer is not None:
                self._kept[kept_as] = answer
            return default if answer is None else answer

    def answered_here(self, what: Any, value: Any) -> Any:
        """Give what Webots' library asks for and the stand-in knows; at the end as if asked."""
        with self.lock:
            self._exit_if_over()
            if not self._quitting:
                self._kept[what] = value
            return self._kept.get(what)

    def know(self, node: NodeFacts) -> None:
        """Remember a node that the simulator has described."""
        self._nodes[node[0]] = node

    def forget(self, node_id: int) -> None:
        """Remember a node no longer: it was removed."""
        self._nodes.pop(node_id, None)

    def find_node(
        self, operation: str, argument: Any, is_it: Callable[[NodeFacts], bool]
    ) -> NodeFacts | None:
        """Ask for a node; at the end it is found among those that are known."""
        with self.lock:
            if not self._quitting:
                found = self._ask(operation, (argument,), [])
                if not self._quitting:
                    if found is None and not self._in_step:
                        self._nodes = {n[0]: n for n in self._nodes.values() if not is_it(n)}
                    return found
            known = next((node for node in reversed(self._nodes.values()) if is_it(node)), None)
            if known is None:
                self._exit_if_over()
            return known

    def find_field(self, operation: str, key: FieldKey) -> tuple[FieldKey, str, int] | None:
        """Ask for a field: where it is, its type and the number of its entries.

        At the end a field that is not known is, as in Webots, the one that was found last.
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
        """The name of a field by its place in the node; at the end, if it was asked for before."""
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
        """Read a field; changes that were not sent yet go first.

        Args:
            field: The field.
            index: Of the entry; None for a single field.
            unread: What is in a field that has not been read before the end.
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
        """Add or remove entries at once; changes that were not sent yet go first."""
        with self.lock:
            return self._ask(operation, (field, *arguments), self._take_field_sets())

    def fetch(self, tag: int) -> Any:
        """The picture or scan that belongs to a sensor's last sample; None before the first.

        The simulator gives it also while it ends the controller.
        """
        with self.lock:
            sample = self._values.get(tag)
            known = self._fetched.get(tag)
            if sample is None or (known and known[0] == sample):
                return known[1] if known else None
            self.link.send(("fetch", tag))
            while (reply := self.link.receive())[0] != "fetched":
                if self._in_step:  # the answer to a step that was begun came first
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
        """Whether the robot has a supervisor's rights; without them a line on stderr says so."""
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
"""The session of the process's one robot; devices made by name belong to it."""
