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
_TOLERANCE_S: Final = 2.0
_WINDOWS_EPOCH_S: Final = 11_644_473_600  # from 1601 to 1970


def process_alive(pid: int, last_seen_wall_time_s: float) -> bool:
    """Whether the process of this host that was last seen then still runs.

    Where the system does not tell when a process started (macOS), any process of that pid counts.
    """
    if sys.platform == "win32":
        started_s = _windows_start(pid)
    else:
        started_s = _posix_start(pid)
    if started_s is None:
        return False
    return started_s <= last_seen_wall_time_s + _TOLERANCE_S


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
    """See proc_pid_stat(5): the state is the third field, the start in clock ticks the 22nd.

    A process that ended but was not yet waited for ("Z") still has a pid.
    """
    try:
        with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123  (no pathlib in the loop)
            fields = file.read().rpartition(b") ")[2].split()
        if fields[0] == b"Z":
            return None
        since_boot_s = int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot_s
    except (OSError, IndexError, ValueError, AttributeError):
        return 0.0


def _windows_start(pid: int) -> float | None:
    """As `_posix_start`; os.kill(pid, 0) would end the process on Windows, asking does not."""
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
    return times[0] / 1e7 - _WINDOWS_EPOCH_S if told else 0.0
