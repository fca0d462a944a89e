"""Orders for a Webots that runs: by its WebSocket, and as the last resort by its keys.

Its WebSocket listens at the port of `--port` in every Webots. Webots carries out orders only where
it was started with `--stream`; its console it sends to every client. This module never sends the
bare words `w3d` and `x3d`, which pause the simulation at its next step.

The keys are those of Webots' menu actions in R2023b to R2025a, with Command in place of Ctrl on
macOS. They go to the window of one Webots, or nowhere.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, cast

from webots_mcp.contract import host_name
from webots_mcp.errors import CommandRefusedError

if TYPE_CHECKING:
    from websockets.frames import Frame

Order = Literal["pause", "resume", "fast", "step", "reset", "reload"]

MAX_MESSAGE_BYTES: Final = 4 << 20
ANSWER_S: Final = 1.0  # Webots answers at once, or it does not obey
_CLOSING_S: Final = 0.2
_CHUNK_BYTES: Final = 1 << 16
_HEAD_END: Final = b"\r\n\r\n"
_LONGEST_HEAD_BYTES: Final = 1 << 16
# A robot of this name need not exist: asking for a window begins the logs for this client.
_BEGIN_CONSOLE: Final = "robot:" + json.dumps(
    {"name": "webots-mcp", "message": "init robot window"}, separators=(",", ":")
)
# What is sent, and how what comes back begins. The time in ms is a limit; negative: none.
_ORDERS: Final[dict[Order, tuple[str, tuple[str, ...]]]] = {
    "pause": ("pause", ("pause",)),  # "paused by client", and "pause: <ms>" to the others
    "resume": ("real-time:-1", ("real-time",)),
    "fast": ("fast:-1", ("fast",)),
    "step": ("step", ("pause", "step")),
    "reset": ("reset", ("reset finished",)),
    "reload": ("reload", ("delete world", "loading:", "world:", "scene load completed")),
}
_SAID_TO_ALL: Final = ("stdout:", "stderr:", "robot")  # also without --stream
_LONGEST_WORDS: Final = 200
_LONGEST_OTHER: Final = 60
RESTARTING: Final = ("reset", "reload")  # may be answered to others, or much later


class WebotsAddress(NamedTuple):
    """Where a Webots listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class Message(NamedTuple):
    """What Webots sent: its text as far as it is kept, or that it answered a ping.

    Attributes:
        dropped_bytes: How much of the end is not kept.
    """

    text: str
    is_pong: bool = False
    dropped_bytes: int = 0


class WebotsLine(NamedTuple):
    """A line of Webots' console, of `stdout` or `stderr`."""

    stream: str
    text: str


class OrderReply(NamedTuple):
    """Webots' reply to an order.

    Attributes:
        text: Webots' own words; None where it did not reply.
        is_alive: Whether its main thread answered at all, so that it is not busy.
        other: Another message of Webots, which only a Webots that accepts orders sends.
    """

    text: str | None
    is_alive: bool
    other: str | None = None


def address_of(instance: str) -> WebotsAddress | None:
    """Where the Webots of a session listens, by its `instance`; None where that is not known."""
    host, _, port = instance.rpartition(":")
    if not (host and port.isascii() and port.isdecimal() and 0 < int(port) < 1 << 16):
        return None
    return WebotsAddress("127.0.0.1" if host == host_name() else host, int(port))


class Stream:
    """A connection to Webots, in this thread alone. Times are those of `time.monotonic`."""

    def __init__(self, address: WebotsAddress, until_s: float) -> None:
        from websockets.client import ClientProtocol
        from websockets.uri import parse_uri

        self.address = address
        self._protocol = ClientProtocol(parse_uri(f"ws://{address}/"), max_size=None)
        self._message = bytearray()
        self._dropped_bytes = 0
        self._socket = socket.create_connection(address, _left_s(until_s))
        self._arrived: list[Message] = []
        try:
            self._shake_hands(until_s)
        except BaseException:
            self._socket.close()
            raise

    def send(self, text: str) -> None:
        """Send a text.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        self._require_open()
        self._protocol.send_text(text.encode())
        self._write()

    def ping(self) -> None:
        """Ask Webots' main thread for a sign of life, which comes after what was sent before.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        self._require_open()
        self._protocol.send_ping(b"webots-mcp")
        self._write()

    def receive(self, until_s: float) -> Message | None:
        """The next message; None if none came in time.

        Raises:
            CommandRefusedError: Webots closed the connection.
        """
        while not self._arrived:
            if not self._read(until_s):
                return None
        return self._arrived.pop(0)

    def close(self) -> None:
        """Send the closing frame, wait a moment for that of Webots, and close the socket."""
        until_s = time.monotonic() + _CLOSING_S
        try:
            self._shake_hands_to_close(until_s)
        finally:
            self._socket.close()

    @property
    def _is_open(self) -> bool:
        from websockets.protocol import OPEN

        return self._protocol.state is OPEN

    def _shake_hands_to_close(self, until_s: float) -> None:
        with suppress(OSError, CommandRefusedError):
            if self._is_open:  # else Webots was first
                self._protocol.send_close(1000)
                self._write()
            while self._read(until_s):
                self._arrived.clear()

    def _shake_hands(self, until_s: float) -> None:
        self._protocol.send_request(self._protocol.connect())
        self._write()
        head = bytearray()
        while _HEAD_END not in head and len(head) < _LONGEST_HEAD_BYTES:
            data = self._bytes(until_s)
            if data is None:
                raise TimeoutError
            if not data:
                break
            head += data
        head_bytes, end, rest = bytes(head).partition(_HEAD_END)
        self._protocol.receive_data(head_bytes + end)
        self._protocol.events_received()
        if not self._is_open:
            why = self._protocol.handshake_exc or "it does not speak as a WebSocket does"
            raise CommandRefusedError(f"what listens at {self.address} is no Webots ({why})")
        self._take(rest)

    def _read(self, until_s: float) -> bool:
        """Take what has come; False if nothing has in time."""
        data = self._bytes(until_s)
        if data is None:
            return False
        if data:
            self._take(data)
            self._write()  # pongs
        if not data or (self._protocol.close_expected() and not self._arrived):
            raise self._closed()
        return True

    def _require_open(self) -> None:
        if not self._is_open:
            raise self._closed()

    def _closed(self) -> CommandRefusedError:
        return CommandRefusedError(f"Webots at {self.address} closed the connection")

    def _take(self, data: bytes) -> None:
        from websockets.frames import Opcode

        self._protocol.receive_data(data)
        for frame in cast("list[Frame]", self._protocol.events_received()):
            if frame.opcode is Opcode.PONG:
                self._arrived.append(Message("", is_pong=True))
            elif frame.opcode in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                self._put_together(frame)

    def _put_together(self, frame: Frame) -> None:
        """Keep of the parts of a message the first bytes.

        The scene of a large world is one message of hundreds of megabytes, in parts of 512 kB, and
        every client gets those that another has asked for.
        """
        room = MAX_MESSAGE_BYTES - len(self._message)
        self._message += frame.data[:room]
        self._dropped_bytes += max(len(frame.data) - room, 0)
        if frame.fin:
            text = self._message.decode("utf-8", "replace")
            self._arrived.append(Message(text, dropped_bytes=self._dropped_bytes))
            self._message, self._dropped_bytes = bytearray(), 0

    def _bytes(self, until_s: float) -> bytes | None:
        """Of the socket; empty at its end, None where nothing came in time."""
        self._socket.settimeout(_left_s(until_s))
        try:
            return self._socket.recv(_CHUNK_BYTES)
        except (TimeoutError, BlockingIOError):
            return None

    def _write(self) -> None:
        self._socket.settimeout(ANSWER_S)  # only a full buffer can make this wait
        for data in self._protocol.data_to_send():
            if data:
                self._socket.sendall(data)


@contextmanager
def connected(address: WebotsAddress, timeout_s: float) -> Generator[Stream]:
    """A connection to Webots.

    Raises:
        CommandRefusedError: Nothing listens there, it is not Webots, it does not answer, or it
            hung up.
    """
    try:
        stream = Stream(address, time.monotonic() + timeout_s)
    except TimeoutError as error:
        raise CommandRefusedError(
            f"what listens at {address} did not answer within {timeout_s:g} s: Webots' main thread "
            "is busy, or it is no Webots"
        ) from error
    except OSError as error:
        raise CommandRefusedError(f"no Webots listens at {address} ({error})") from error
    try:
        yield stream
    except OSError as error:
        raise CommandRefusedError(
            f"the connection to Webots at {address} broke: {error}"
        ) from error
    finally:
        stream.close()


def give_order(address: WebotsAddress, order: Order, timeout_s: float = ANSWER_S) -> OrderReply:
    """Send Webots an order, and return its reply.

    Raises:
        CommandRefusedError: There is no Webots to speak to.
    """
    words, answers = _ORDERS[order]
    return _give(address, words, answers, timeout_s, late=order in RESTARTING)


def load_world(address: WebotsAddress, file_name: str, timeout_s: float = ANSWER_S) -> OrderReply:
    """Have Webots open another world of the folder of the present one.

    Raises:
        CommandRefusedError: There is no Webots to speak to.
    """
    return _give(address, f"load:{file_name}", _ORDERS["reload"][1], timeout_s, late=True)


def _give(
    address: WebotsAddress, words: str, answers: tuple[str, ...], timeout_s: float, *, late: bool
) -> OrderReply:
    until_s = time.monotonic() + timeout_s
    is_alive, other = False, None
    with connected(address, timeout_s) as stream:
        stream.send(words)
        stream.ping()
        while (message := stream.receive(until_s)) is not None:
            line = message.text.partition("\n")[0][:_LONGEST_WORDS]
            if line.startswith(answers):
                return OrderReply(line, is_alive=True)
            if not (message.is_pong or line.startswith(_SAID_TO_ALL)):
                other = other or line[:_LONGEST_OTHER]
            is_alive = is_alive or message.is_pong
            if is_alive and not late:
                # Words are answered in their order: what comes now is about something else.
                until_s = min(until_s, time.monotonic() + _CLOSING_S)
    return OrderReply(None, is_alive, other)


def why_not_obeyed(address: WebotsAddress, reply: OrderReply) -> str:
    """Why Webots did not answer an order, as far as that is known."""
    if reply.other is not None:
        return (
            f"Webots at {address} answered {reply.other!r}, which does not show whether it obeyed: "
            "check its window, or the recording"
        )
    if reply.is_alive:
        return (
            f"Webots at {address} receives orders but does not obey them: it was started without "
            "--stream; restart it with that option"
        )
    return (
        f"Webots at {address} did not answer within {ANSWER_S:g} s: it was started without "
        "--stream, or its main thread is busy and may still obey later"
    )


def begin_console(stream: Stream) -> None:
    """Have Webots send its console to all its clients, from the first line not sent yet."""
    stream.send(_BEGIN_CONSOLE)


def console_lines(text: str) -> Iterator[WebotsLine]:
    """The lines of a message; each names its stream, those that go on with it do not.

    Empty ones are left out: where a line of a controller ends, there is one.
    """
    kind = None
    for line in text.split("\n"):
        head, colon, rest = line.partition(":")
        if colon and head in ("stdout", "stderr"):
            kind, line = head, rest
        if kind is None:  # it is about something else
            return
        if line.strip():
            yield WebotsLine(kind, line)


def _left_s(until_s: float) -> float:
    return max(until_s - time.monotonic(), 0.001)


_PRESSING_TIMEOUT_S: Final = 10.0
_ON_MACOS: Final = (
    "allow the program that runs this under System Settings, Privacy & Security, Accessibility"
)
_ON_WINDOWS: Final = (
    "it needs exactly one window of Webots, and Windows' leave to bring it to the front"
)
_TITLE: Final = "Webots R20"  # "<world> (<project>) - Webots R2023b"


class Key(NamedTuple):
    """What is pressed together with Ctrl, or Command."""

    name: str
    shift: bool = False

    @property
    def spoken(self) -> str:
        """As a person reads it."""
        return f"Ctrl+{'Shift+' * self.shift}{self.name.upper()}"


KEYS: Final[dict[Order, Key]] = {
    "pause": Key("0"),
    "step": Key("1"),
    "resume": Key("2"),
    "fast": Key("3"),
    "reset": Key("t", shift=True),
    "reload": Key("r", shift=True),
}


def press(order: Order, pid: int | None, platform: str = sys.platform) -> None:
    """Press the keys of an order in Webots' window.

    Args:
        order: What Webots is to do.
        pid: The process of the wanted Webots; None where there can be only one.
        platform: As `sys.platform` names it.

    Raises:
        CommandRefusedError: The window was not found, the keys could not be sent, or how that
                is done on this platform is not known.
    """
    key = KEYS[order]
    try:
        if platform == "linux":
            _press_in_x11(key, pid)
        elif platform == "darwin":
            _run(macos_command(key, pid), _ON_MACOS)
        elif platform == "win32":
            _run(windows_command(key, pid), _ON_WINDOWS)
        else:
            raise CommandRefusedError(f"no way to press keys on {platform!r} is known")
    except CommandRefusedError as error:
        raise CommandRefusedError(f"{error}; or press {key.spoken} in Webots yourself") from error


def macos_command(key: Key, pid: int | None) -> list[str]:
    """The command that presses a key on macOS, in the window of that process."""
    of_pid = (
        'tell application "System Events" to set frontmost of '
        f"(first process whose unix id is {pid}) to true"
    )
    held = "{command down, shift down}" if key.shift else "{command down}"
    script = (
        'tell application "Webots" to activate' if pid is None else of_pid,
        "delay 0.3",
        f'tell application "System Events" to keystroke "{key.name}" using {held}',
    )
    return ["osascript", *(part for line in script for part in ("-e", line))]


def windows_command(key: Key, pid: int | None) -> list[str]:
    """The command that presses a key on Windows; its exit code is 3 where no one window is it."""
    wanted = f"$_.MainWindowTitle -like '*{_TITLE}*'" + (f" -and $_.Id -eq {pid}" if pid else "")
    script = (
        f"$found = @(Get-Process | Where-Object {{ {wanted} }}); "
        "if ($found.Count -ne 1) { exit 3 }; "
        "$shell = New-Object -ComObject WScript.Shell; "
        "if (-not $shell.AppActivate($found[0].Id)) { exit 4 }; "
        "Start-Sleep -Milliseconds 300; "
        f"$shell.SendKeys('^{'+' * key.shift}{key.name}')"
    )
    return ["powershell", "-NoProfile", "-NonInteractive", "-Command", script]


def _press_in_x11(key: Key, pid: int | None) -> None:
    window = _x11_window(pid)
    keys = f"ctrl+{'shift+' * key.shift}{key.name}"
    to_front = _attempt(["xdotool", "windowactivate", "--sync", window])
    if to_front.returncode:  # there is no window manager
        _run(["xdotool", "windowfocus", "--sync", window], "its window cannot have the focus")
    _run(["xdotool", "key", "--clearmodifiers", keys], "the X server did not take the keys")


def _x11_window(pid: int | None) -> str:
    """The only window of Webots, of that process where windows have a process id.

    Raises:
        CommandRefusedError: There is none, or it is not clear which of several.
    """
    found = _attempt(["xdotool", "search", "--onlyvisible", "--name", f" - {_TITLE}"])
    windows = found.stdout.split()
    found = [each for each in windows if pid is None or _owner(each) in (pid, None)]
    if len(found) == 1:
        return found[0]
    if found:
        raise CommandRefusedError(f"{len(found)} windows could be that of the wanted Webots")
    where = f"on the display {os.environ.get('DISPLAY') or '(DISPLAY is not set)'}"
    if os.environ.get("WAYLAND_DISPLAY"):
        where += "; this is a Wayland session, which hides windows from xdotool"
    raise CommandRefusedError(f"no window of Webots was found {where}")


def _owner(window: str) -> int | None:
    printed = _attempt(["xdotool", "getwindowpid", window]).stdout.strip()
    return int(printed) if printed.isdecimal() else None


def _run(command: Sequence[str], advice: str) -> None:
    ended = _attempt(command)
    if ended.returncode:
        reason = ended.stderr.strip()[:300] or f"exit code {ended.returncode}"
        raise CommandRefusedError(f"{command[0]} did not press the keys ({reason}): {advice}")


def _attempt(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command,
            check=False,
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
            timeout=_PRESSING_TIMEOUT_S,
        )
    except FileNotFoundError as error:
        install = " (apt install xdotool)" if command[0] == "xdotool" else ""
        raise CommandRefusedError(f"the program {command[0]} is not there{install}") from error
    except (OSError, subprocess.TimeoutExpired) as error:
        raise CommandRefusedError(f"{command[0]} could not be run: {error}") from error
