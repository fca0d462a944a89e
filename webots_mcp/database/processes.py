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
    """Return whether the process of a session that has not ended still runs.

    On this host the process shows it, as `process_alive` says; on another only a recent heartbeat
    does.
    """
    if host != host_name():
        return now_s - last_seen_wall_time_s < REMOTE_SILENCE_S
    return process_alive(pid, process, last_seen_wall_time_s)


def process_alive(pid: int, process: str | None, last_seen_wall_time_s: float) -> bool:
    """Return whether a process of this host still runs.

    Args:
        pid: Its id, which another process may have by now.
        process: Its `process_identity`, which no other process has.
        last_seen_wall_time_s: Its newest sign of life in Unix time, which decides if the identity
            is unknown. If the system does not show when a process started (macOS), any process of
            that pid counts.
    """
    if not (_is_pid(pid) and isinstance(last_seen_wall_time_s, (int, float))):  # pyright: ignore[reportUnnecessaryIsInstance]
        return False  # no bridge has written this: a file may have any origin
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
    """Return a text that identifies the process which now has that pid, whatever the clock shows.

    A pid is used again, but never with the same start in the same boot. On Windows the text is the
    creation time, which does not change when the clock is set. None if no such process runs, or
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
    """Return the Unix time of a process' start; 0 if it is not shown, None without a process."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass  # it lives, under another user
    return _linux_start(pid)


def _linux_start(pid: int) -> float | None:
    """Return a process' start; None for one that has ended and keeps its pid until waited for."""
    try:
        fields = _linux_stat(pid)
        if fields[0] == b"Z":
            return None
        since_boot_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot_s
    except (OSError, IndexError, ValueError, AttributeError):
        return 0.0


def _linux_stat(pid: int) -> list[bytes]:
    """Read the fields of proc_pid_stat(5) from the third on, the state; the 22nd is the start."""
    with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123  (no pathlib in the loop)
        return file.read().rpartition(b") ")[2].split()


def is_stopped(pid: int) -> bool:
    """Return whether a signal or a debugger has stopped a process; only Linux shows that."""
    try:
        return _linux_stat(pid)[0] in (b"T", b"t")
    except (OSError, IndexError):
        return False


def has_lost_simulator(pid: int, instance: str) -> bool:
    """Return whether Webots has closed its connection to a controller that still waits for it.

    Over TCP, Webots' library then waits forever for an answer; over a local socket it ends the
    process. Only Linux shows this, and only to the user who owns the process.

    Args:
        pid: The controller's process.
        instance: Its simulator as `host:port`, see `contract.instance_of`.
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
    """Yield the targets of a process' file descriptors; one may be closed meanwhile."""
    folder = f"/proc/{pid}/fd"
    for name in os.listdir(folder):  # noqa: PTH208
        with suppress(FileNotFoundError):
            yield os.readlink(f"{folder}/{name}")  # noqa: PTH115


def _connections_to(pid: int, port: int) -> Generator[tuple[str, bool]]:
    """Yield the sockets of a process' network that lead to a port: inode, and whether closed."""
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
    """Send a signal that would end a process without a handler for it. Linux only.

    It is sent only if the process is still the one of that identity (`process_identity`), and has
    a handler installed: another program, started by `exec`, has none.

    Raises:
        OSError: If no such process runs, or the system does not show it.
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
    """Return the Unix time of a process' start; 0 if it is not shown, None without a process."""
    created = _windows_creation(pid)
    epoch_s = 11_644_473_600  # from 1601 to 1970
    return created / 1e7 - epoch_s if created else created


def _windows_creation(pid: int) -> int | None:
    """Return a process' creation time in units of 100 ns since 1601.

    Returns:
        0 if the system does not show it, None if there is no process. `os.kill(pid, 0)` would end
        the process on Windows; this does not.
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
