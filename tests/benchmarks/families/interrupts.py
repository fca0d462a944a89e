"""What an interrupt (Ctrl-C) costs, at each single instruction of the write path."""

from __future__ import annotations

import random
from collections.abc import Iterable

from tests.benchmarks.registry import Bench, benchmark
from tests.benchmarks.table import Line, Target
from tests.bridge.interrupting import Interrupter, Outcome, drive, make_template, places

_INTERRUPTS = 2000


@benchmark("interrupts", "controllers interrupted (Ctrl-C) inside the bridge")
def measure_interrupts(bench: Bench) -> Iterable[Line]:
    template = make_template(bench.folder)
    found = places(bench.folder / "look", instructions=True)
    wanted = min(bench.count(_INTERRUPTS), len(found))
    chosen = random.Random(1).sample(found, wanted)
    outcomes: list[Outcome] = []
    for number, at in enumerate(chosen):
        bench.say(f"{number} of {wanted}")
        interrupter = Interrupter(instructions=True, at=at, template=template)
        outcomes.append(drive(bench.folder / f"{number}", interrupter))
    reached = [outcome for outcome in outcomes if outcome.interrupted]
    for name, what in (
        ("missing", "rows missing"),
        ("doubled", "rows written twice"),
        ("blocked", "other writers locked out"),
        ("held", "recorder held, or in a transaction"),
    ):
        count = sum(int(getattr(outcome, name)) for outcome in reached)
        ours = f"{len(reached):,} interrupts"
        yield Line(what, ours, f"{len(found):,} places", count, "times", Target(0))
