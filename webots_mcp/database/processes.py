"""Whether the process of a session still runs, as the host's operating system shows it.

A controller may be silent for hours, paused in Webots, and live: a process that runs is alive
however long its last heartbeat is ago. A process that started after that heartbeat is another one
which has only inherited the pid: after a reboot, or in a container that was started again.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Generator
from contextlib import suppress
from typing import Any, Final

from webots_mcp.contract import REMOTE_SILENCE_S, host_name

_TOLERANCE_S: Final = 2.0  # between the clock of a start and that of a heartbeat
_CONNECTION_STATES: Final = {"01": False, "08": True}  # tcp(7): open; closed by the other end


def is_living(
    host: str, pid: int, process: str | None, last_seen_wall_time_s: float, now_s: float
) -> bool:
    """Whether the process of a session that has not ended still runs.

    On this host the process shows it, as `process_alive` says; on another only a recent heartbeat
    does.
    """
    if host != host_name():
        return now_s - last_seen_wall_time_s < REMOTE_SILENCE_S
    return process_alive(pid, process, last_seen_wall_time_s)


def process_alive(pid: int, process: str | None, last_seen_wall_time_s: float) -> bool:
    """Whether a process of this host still runs.

    Args:
        pid: Its id, which another process may have by now.
        process: Its `process_identity`, which no other has, whatever clocks are set to.
        last_seen_wall_time_s: Its newest sign of life, Unix time: what there is to go by where the
            identity is not known. Where the system does not show either when a process started
            (macOS), any process of that pid counts.
    """
    if not (_is_pid(pid) and isinstance(last_seen_wall_time_s, (int, float))):  # pyright: ignore[reportUnnecessaryIsInstance]
        return False  # no bridge has written this: a recording may come from anywhere
    now = process_identity(pid) if process is not None else None
    if now is not None:
        return now == process
    if sys.platform == "win32":
        started_s = _windows_start(pid)
    else:
        started_s = _posix_start(pid)
    if started_s is None:
        return False
    return started_s <= last_seen_wall_time_s + _TOLERANCE_S


def _is_pid(pid: object) -> bool:
    return isinstance(pid, int) and 0 < pid < 2**31  # no system gives a process a higher id


def process_identity(pid: int) -> str | None:
    """Which process of this host that pid names now, whatever the wall clock is set to.

    A pid comes back; its boot and its start within that boot do not. On Windows the creation
    time, which setting the clock does not change afterwards. None where no such process runs, or
    the system does not show it (macOS).
    """
    if sys.platform == "win32":
        created = _windows_creation(pid)
        return f"{created}" if created else None
    try:
        fields = _linux_stat(pid)
        if fields[0] == b"Z":
            return None
        with open("/proc/sys/kernel/random/boot_id", "rb") as file:  # noqa: PTH123
            return f"{file.read().decode().strip()} {int(fields[19])}"
    except (OSError, IndexError, ValueError):
        return None


def _posix_start(pid: int) -> float | None:
    """Unix time of the process' start; 0 where it is not shown, None where there is no process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass  # it lives, under another user
    return _linux_start(pid)


def _linux_start(pid: int) -> float | None:
    """A process that ended but was not yet waited for ("Z") still has a pid."""
    try:
        fields = _linux_stat(pid)
        if fields[0] == b"Z":
            return None
        since_boot_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot_s
    except (OSError, IndexError, ValueError, AttributeError):
        return 0.0


def _linux_stat(pid: int) -> list[bytes]:
    """From its state on, which proc_pid_stat(5) has third; the start in clock ticks is 22nd."""
    with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123  (no pathlib in the loop)
        return file.read().rpartition(b") ")[2].split()


def is_stopped(pid: int) -> bool:
    """Whether a signal or a debugger has stopped a process; only Linux shows that."""
    try:
        return _linux_stat(pid)[0] in (b"T", b"t")
    except (OSError, IndexError):
        return False


def has_lost_simulator(pid: int, instance: str) -> bool:
    """Whether Webots has closed its connection to a controller, which waits for it regardless.

    Over TCP, Webots' library then waits for an answer without end; over a local socket it ends the
    process. Only Linux shows it, to the user whose process it is.

    Args:
        pid: The controller's process.
        instance: Its simulator, as `contract.instance_of` names it: `host:port`.
    """
    port = instance.rpartition(":")[2]
    if not (_is_pid(pid) and port.isascii() and port.isdecimal()):
        return False
    try:
        closed_by_inode = dict(_connections_to(pid, int(port)))
        inodes = set(_open_files(pid))
    except (OSError, ValueError, IndexError):
        return False
    found = [closed for inode, closed in closed_by_inode.items() if f"socket:[{inode}]" in inodes]
    return bool(found) and all(found)


def _open_files(pid: int) -> Generator[str]:
    """What the descriptors of a process lead to; one may be closed meanwhile."""
    folder = f"/proc/{pid}/fd"
    for name in os.listdir(folder):  # noqa: PTH208
        with suppress(FileNotFoundError):
            yield os.readlink(f"{folder}/{name}")  # noqa: PTH115


def _connections_to(pid: int, port: int) -> Generator[tuple[str, bool]]:
    """Sockets in the network of a process that lead to a port: inode, and whether it is closed."""
    for table in ("tcp", "tcp6"):
        with suppress(FileNotFoundError), open(f"/proc/{pid}/net/{table}") as file:  # noqa: PTH123
            for line in file.readlines()[1:]:
                fields = line.split()
                if (
                    int(fields[2].rpartition(":")[2], 16) == port
                    and fields[3] in _CONNECTION_STATES
                ):
                    yield fields[9], _CONNECTION_STATES[fields[3]]


def signal_process(pid: int, process: str | None, number: int) -> None:
    """Send a signal that would end whoever does not expect it.

    It is sent to that very process (`process_identity`) only, not to another of its pid, and where
    a handler is installed: another program, begun by `exec`, has none. Linux only.

    Raises:
        OSError: No such process runs, or the system does not tell.
    """
    if sys.platform != "linux":
        return
    import signal

    handle = os.pidfd_open(pid)
    try:
        with open(f"/proc/{pid}/status", "rb") as file:  # noqa: PTH123
            caught = int(file.read().partition(b"\nSigCgt:")[2].split()[0], 16)
        if caught >> number - 1 & 1 and process is not None and process_identity(pid) == process:
            signal.pidfd_send_signal(handle, number)
    finally:
        os.close(handle)


def _windows_start(pid: int) -> float | None:
    """As `_posix_start`."""
    created = _windows_creation(pid)
    epoch_s = 11_644_473_600  # from 1601 to 1970
    return created / 1e7 - epoch_s if created else created


def _windows_creation(pid: int) -> int | None:
    """In 100 ns since 1601; 0 where it is not shown, None where there is no process.

    os.kill(pid, 0) would end the process on Windows, asking does not.
    """
    import ctypes

    query_limited_information, still_active = 0x1000, 259
    kernel: Any = getattr(ctypes, "WinDLL")("kernel32")  # noqa: B009  (exists on Windows only)
    handle = kernel.OpenProcess(query_limited_information, False, pid)
    if not handle:
        return None
    code, times = ctypes.c_ulong(), (ctypes.c_ulonglong * 4)()  # created, ended, kernel, user
    kernel.GetExitCodeProcess(handle, ctypes.byref(code))
    known = kernel.GetProcessTimes(handle, *(ctypes.byref(times, 8 * i) for i in range(4)))
    kernel.CloseHandle(handle)
    if code.value != still_active:
        return None
    return int(times[0]) if known else 0
