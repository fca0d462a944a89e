"""Redirects a file descriptor of this process into a pipe, and restores it."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class PipeLimits:
    """Limits of pipes.

    Attributes:
        bytes: Size of a pipe; a print blocks only once the pipe is full.
        descriptors: FD_SETSIZE: select() cannot watch a higher descriptor.
    """

    bytes: int = 1 << 20
    descriptors: int = 1024


_PIPE: Final = PipeLimits()


class Redirection:
    """A file descriptor whose output goes into a pipe from now on.

    Args:
        descriptor: The descriptor, such as 1 for stdout.
        blocking: Whether reading an empty pipe waits for data.

    Attributes:
        read_end: The end of the pipe from which the output is read.
        destination: A copy of the original descriptor.

    Raises:
        OSError: The descriptor is closed, or too many files are open.
    """

    def __init__(self, descriptor: int, *, blocking: bool) -> None:
        self._descriptor = descriptor
        self.destination = os.dup(descriptor)
        self.read_end, write_end = os.pipe()
        if max(self.read_end, self.destination) >= _PIPE.descriptors:
            os.close(write_end)
            self.close()
            raise OSError("too many files are open")
        _enlarge(write_end)
        if not blocking:  # never on Windows, where Python before 3.12 cannot set it
            os.set_blocking(self.read_end, False)
        os.dup2(write_end, descriptor)
        self._pipe = os.fstat(write_end)
        os.close(write_end)

    def restore(self) -> None:
        """Restore the descriptor, unless other code has redirected or closed it since."""
        try:
            is_ours = os.path.samestat(os.fstat(self._descriptor), self._pipe)
        except OSError:  # other code has closed it
            return
        if is_ours:
            os.dup2(self.destination, self._descriptor)

    def close(self) -> None:
        """Close the pipe's read end and the copy of the original descriptor."""
        os.close(self.read_end)
        os.close(self.destination)


def _enlarge(pipe: int) -> None:
    """Enlarge a pipe where the system allows it: on Linux."""
    if sys.platform == "linux":
        import fcntl

        try:
            fcntl.fcntl(pipe, fcntl.F_SETPIPE_SZ, _PIPE.bytes)
        except OSError:  # the user's limit for pipes is reached: the default size remains
            return
