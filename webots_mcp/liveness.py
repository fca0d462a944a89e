"""Whether the process that entered a session still runs, as its host's operating system says.

Standard library only, because the bridge imports it inside a robot's controller.
"""

from __future__ import annotations

import os
import sys
import time
from typing import Any, Final

# A controller may be silent for hours (paused in Webots) and live; so it is not the silence that
# decides. But a process that started after the last sign of life has only inherited the pid: after
# a reboot, in a container that was started again. Clocks are trusted to so much:
_PIDS: Final = 2**31  # no system gives a process a higher id
_TOLERANCE_S: Final = 2.0
_WINDOWS_EPOCH_S: Final = 11_644_473_600  # from 1601 to 1970


def process_alive(pid: int, process: str | None, last_seen_wall_time_s: float) -> bool:
    """Whether a process of this host still runs.

    Args:
        pid: Its id, which another process may have by now.
        process: Its `process_identity`, which no other has, whatever clocks are set to.
        last_seen_wall_time_s: Its newest sign of life, Unix time: what there is to go by where the
            identity is not known. Where the system does not tell either when a process started
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
    return isinstance(pid, int) and 0 < pid < _PIDS


def process_identity(pid: int) -> str | None:
    """Which process of this host that pid names now, whatever the wall clock is set to.

    A pid comes back; its boot and its start within that boot do not. On Windows the creation
    time, which setting the clock does not change afterwards. None where no such process runs, or
    the system does not tell (macOS).
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
    """Unix time of the process' start, 0 where it is not told, None where there is no process."""
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


def _windows_start(pid: int) -> float | None:
    """As `_posix_start`."""
    created = _windows_creation(pid)
    return created / 1e7 - _WINDOWS_EPOCH_S if created else created


def _windows_creation(pid: int) -> int | None:
    """In 100 ns since 1601; 0 where it is not told, None where there is no process.

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
    told = kernel.GetProcessTimes(handle, *(ctypes.byref(times, 8 * i) for i in range(4)))
    kernel.CloseHandle(handle)
    if code.value != still_active:
        return None
    return int(times[0]) if told else 0
