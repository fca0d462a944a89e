"""Why a controller does not repeat itself: what it used that differs from run to run.

The functions that bring chance, the wall clock or other threads into a program are replaced in a
replay by ones that also note the first line of the user's code that called them.
"""

from __future__ import annotations

import builtins
import functools
import random
import secrets
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

from webots_mcp.database.tapes.package_surface import caller_frame
from webots_mcp.database.tapes.source_files import relative_source

_CLOCKS: Final = (
    "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns",
    "process_time", "localtime", "gmtime", "ctime", "strftime",
)  # fmt: skip
_DRAWS: Final = (
    "random", "uniform", "gauss", "normalvariate", "randint", "randrange", "choice", "choices",
    "sample", "shuffle", "triangular", "betavariate", "expovariate", "vonmisesvariate",
)  # fmt: skip
_NUMPY_DRAWS: Final = (
    "rand", "randn", "random", "normal", "uniform", "randint", "choice", "shuffle", "permutation",
    "standard_normal", "random_sample",
)  # fmt: skip
_CONVERT: Final = {"localtime": 1, "gmtime": 1, "ctime": 1, "strftime": 2}
"""Number of arguments with which a function of `time` converts a time and asks no clock."""
_NEVER: Final = 1000
_DATETIME: Final = (".now()", ".utcnow()", ".today()")
RANDOM, CLOCK, THREADS, ORDER = (
    "random numbers without a seed", "the wall clock", "another thread",
    "the order of a set, which Python changes from process to process",
)  # fmt: skip


class Witness(NamedTuple):
    """The first use of something that differs from run to run."""

    cause: str
    call: str
    place: str
    round: int

    def __str__(self) -> str:
        return f"{self.cause} ({self.call} at {self.place})"


class Witnesses:
    """Notes the first use of each cause by the user's code.

    Args:
        root: The folder of the project.
        round_of: Returns the round that the replay has come to.
    """

    def __init__(self, root: Path, round_of: Callable[[], int]) -> None:
        self._root = root
        self._round_of = round_of
        self._seeded: set[str] = set()
        self._watches_numpy = False
        self.found: dict[str, Witness] = {}

    def begin(self) -> None:
        """Replace the functions; before the user's code imports them."""
        self._watch(time, "time", _CLOCKS, CLOCK)
        self._watch(random, "random", _DRAWS, RANDOM)
        self._watch(uuid, "uuid", ("uuid1", "uuid4"), RANDOM)
        self._watch(secrets, "secrets", ("token_bytes", "randbelow", "choice"), RANDOM)
        self._watch_seed(random, "random")
        start = threading.Thread.start

        def begin_thread(thread: threading.Thread) -> None:
            self._note(THREADS, "Thread.start", caller_frame(1))
            start(thread)

        vars_of_thread: Any = threading.Thread
        vars_of_thread.start = begin_thread

        self._watch_numpy_once_imported()

    def _watch_numpy_once_imported(self) -> None:
        load = builtins.__import__

        def load_and_watch(*args: Any, **kwargs: Any) -> Any:
            module = load(*args, **kwargs)
            self._watch_numpy()
            return module

        builtins.__import__ = load_and_watch

    def _watch_numpy(self) -> None:
        numpy = sys.modules.get("numpy.random")
        if not self._watches_numpy and hasattr(numpy, "default_rng") and hasattr(numpy, "seed"):
            self._watches_numpy = True
            self._watch(numpy, "numpy.random", _NUMPY_DRAWS, RANDOM)
            self._watch_seed(numpy, "numpy.random")
            self._watch_default(numpy)

    def _watch(self, module: Any, shown: str, names: Iterable[str], cause: str) -> None:
        for name in names:
            original = getattr(module, name, None)
            if original is not None:
                setattr(module, name, self._watched(original, shown, name, cause))

    def _watched(self, original: Any, shown: str, name: str, cause: str) -> Any:
        converts = _CONVERT.get(name, _NEVER)

        @functools.wraps(original)
        def call(*args: Any, **kwargs: Any) -> Any:
            if len(args) < converts and shown not in self._seeded and cause not in self.found:
                self._note(cause, f"{shown}.{name}", caller_frame(1))
            return original(*args, **kwargs)

        return call

    def _watch_seed(self, module: Any, shown: str) -> None:
        original = module.seed

        def seed(*args: Any, **kwargs: Any) -> Any:
            if (args and args[0] is not None) or kwargs:
                self._seeded.add(shown)
            return original(*args, **kwargs)

        module.seed = seed

    def _watch_default(self, module: Any) -> None:
        original = module.default_rng

        def default_rng(*args: Any, **kwargs: Any) -> Any:
            if not args and not kwargs:
                self._note(RANDOM, "numpy.random.default_rng()", caller_frame(1))
            return original(*args, **kwargs)

        module.default_rng = default_rng

    def _note(self, cause: str, call: str, frame: Any) -> None:
        file = relative_source(frame.f_code.co_filename, self._root)
        if file is not None and cause not in self.found:
            place = f"{file}:{frame.f_lineno}"
            self.found[cause] = Witness(cause, call, place, self._round_of())


_OUTSIDE: Final = (  # what a replay has as it is today; searched for where nothing else explains it
    ("an environment variable", ("os.environ", "getenv(")),
    ("a file that may have changed since", ("open(", "read_text(", "read_bytes(", ".load(")),
    ("the state of another process", ("subprocess.", "socket.", "input(")),
)


def outside_lines(sources: dict[str, str]) -> list[Witness]:
    """Return the first line for each thing outside of the code that a controller may depend on."""
    found: dict[str, Witness] = {}
    for file, text in sources.items():
        for number, line in enumerate(text.splitlines(), 1):
            code = line.partition("#")[0]
            for cause, calls in _OUTSIDE:
                call = next((each for each in calls if each in code), None)
                if call is not None and cause not in found:
                    found[cause] = Witness(cause, call.strip("(."), f"{file}:{number}", 0)
    return list(found.values())


def dated_lines(sources: dict[str, str]) -> list[Witness]:
    """Return the first line that asks `datetime` for the time, whose type cannot be replaced."""
    for file, text in sources.items():
        for number, line in enumerate(text.splitlines(), 1):
            for call in _DATETIME:
                if call in line.partition("#")[0]:
                    return [Witness(CLOCK, f"datetime{call}", f"{file}:{number}", 0)]
    return []
