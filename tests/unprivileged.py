"""Run Python as a user whom the permissions of files stop, also where that user is root.

    python -m tests.unprivileged ARGUMENT...

Root may write what nobody may write, on Linux by two of its capabilities; they are given up here.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

POSSIBLE: Final = sys.platform.startswith("linux") or (
    sys.platform != "win32" and os.geteuid() != 0
)
_PR_CAPBSET_DROP: Final = 24
_CAP_DAC_OVERRIDE: Final = 1
_CAP_DAC_READ_SEARCH: Final = 2


def line(*arguments: str) -> list[str]:
    """The command line that runs Python with these arguments so."""
    return [sys.executable, "-m", __name__, *arguments]


@contextmanager
def unwritable(folder: Path) -> Generator[None]:
    """Inside the block nobody may write into the folder, nor what is in it."""
    modes = {path: path.stat().st_mode for path in (folder, *folder.rglob("*"))}
    try:
        for path, mode in modes.items():
            path.chmod(mode & ~0o222)
        yield
    finally:
        for path, mode in modes.items():
            path.chmod(mode)


def main() -> None:
    """What a process may do is settled when its program starts: so another one is started."""
    if os.geteuid() == 0:
        library = ctypes.CDLL(None, use_errno=True)
        for capability in (_CAP_DAC_OVERRIDE, _CAP_DAC_READ_SEARCH):
            if library.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0):
                raise OSError(ctypes.get_errno(), "this privilege cannot be given up")
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])


if __name__ == "__main__":
    main()
