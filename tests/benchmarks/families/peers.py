"""Recording a state, beside what others record with."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Final, Protocol

from tests.benchmarks.measuring import Samples, alternate, ratio, time_calls
from tests.benchmarks.peers import Mcap, Rerun
from tests.benchmarks.registry import Bench, NotMeasurableError, benchmark
from tests.benchmarks.rover import Rover
from tests.benchmarks.states import State, make_states
from tests.benchmarks.table import Line, duration
from tests.benchmarks.ways import BridgeWay, RawSqlite

_BLOCKS: Final = 20
_CALLS: Final = 200
_PEERS: Final = {
    "MCAP, flushed per message": Mcap,
    "Rerun, to a file, flushed per state": Rerun,
}


class _Recorder(Protocol):
    def publish(self, state: State) -> object: ...

    def close(self) -> None: ...


@benchmark(
    "peers", "a state of 39 leaves, beside other recorders (none of them answers a question)"
)
def measure_peers(bench: Bench) -> Iterable[Line]:
    robot, missing = Rover(), list[str]()
    with ExitStack() as stack:
        ours = stack.enter_context(closing(BridgeWay(robot, bench.place("bridge"))))
        ours.begin()
        contenders: dict[str, _Recorder] = {
            "ours": ours,
            "raw sqlite3": stack.enter_context(closing(RawSqlite(bench.place("raw")))),
        }
        for name, peer in _PEERS.items():
            with _noting(missing):
                contenders[name] = stack.enter_context(closing(peer(bench.place(name))))
        calls = bench.count(_CALLS, least=10)
        bench.say(", ".join(contenders))
        taken = alternate(
            {name: _calling(way, robot, calls) for name, way in contenders.items()},
            bench.count(_BLOCKS, least=2),
        )
    yield from _lines({name: Samples(blocks) for name, blocks in taken.items()})
    if missing:
        raise NotMeasurableError("; ".join(missing))


@contextmanager
def _noting(missing: list[str]) -> Generator[None]:
    """Note what is not installed, and go on without it."""
    try:
        yield
    except NotMeasurableError as error:
        missing.append(str(error))


def _calling(way: _Recorder, robot: Rover, calls: int) -> Callable[[], list[float]]:
    states = make_states()

    def call(i: int) -> None:
        robot.step(8)
        way.publish(states[i % len(states)])

    return lambda: time_calls(call, calls)


def _lines(taken: dict[str, Samples]) -> Iterator[Line]:
    ours = taken.pop("ours")
    for name, theirs in taken.items():
        beside = f"{name} {duration(theirs.p50)}"
        yield Line("publish, p50", duration(ours.p50), beside, ratio(ours, theirs))
