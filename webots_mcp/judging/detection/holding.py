"""Grips that were lost: a force that fell to that of the open gripper, though it stayed closed.

A gripper that holds something has a force; while its command stays, that force ends only where the
thing is gone. What it is while the gripper is open is known from the same run.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

from webots_mcp.analysis.arrays import Array, constant_runs, np, runs_of
from webots_mcp.judging.detection.search import Search
from webots_mcp.signals.meaning import HOLDING, is_asked_for, words_in
from webots_mcp.store.registered_signals import RegisteredSignal

HELD_S: Final = 1.0  # it held for so long before, and was empty for so long
_EMPTY: Final = 0.1  # of the way from the force of the open gripper to that of one that holds
_HOLDS: Final = 0.5  # of that way
_ERRORS: Final = 10.0  # standard deviations of its noise that both forces are apart
_GRIPPING: Final = HOLDING | {"grip", "suction", "vacuum"}


class Grip(NamedTuple):
    """The force of a gripper, and the command that it follows."""

    force: RegisteredSignal
    command: RegisteredSignal


class LostGrip(NamedTuple):
    """From when to when a closed gripper was empty, after it had held something."""

    start_s: float
    end_s: float
    held: float
    empty: float


def grips_in(search: Search) -> list[Grip]:
    """Return the forces and pressures of grippers, each with the command in its branch."""
    known, whole = search.known, search.whole
    branches = {name: own.rpartition(".")[0] for name, own in search.own_names.items()}
    found: list[Grip] = []
    for name, meaning in search.meanings.items():
        branch = branches[name]
        words = frozenset(words_in(name))
        if meaning.quantity not in ("force", "pressure") or meaning.sets or name not in whole:
            continue
        if words.isdisjoint(_GRIPPING):
            continue
        commands = [
            each
            for each in known
            if branches[each] == branch and is_asked_for(each) and each in whole
            if branch or not frozenset(words_in(each)).isdisjoint(words & _GRIPPING)
        ]
        if len(commands) == 1 and known[commands[0]].is_number:
            found.append(Grip(known[name], known[commands[0]]))
    return found


def lost_grips(search: Search, grip: Grip) -> Iterator[LostGrip]:
    """Yield where a gripper was empty although its command stayed since it held something."""
    whole = search.whole
    forces, commands = (whole.numbers(each.name) for each in grip)
    there = np.flatnonzero(np.isfinite(forces) & np.isfinite(commands))
    if len(there) < 2:
        return
    times, forces, commands = whole.times[there], forces[there], commands[there]
    levels = {value: float(np.median(forces[commands == value])) for value in _often(commands)}
    if len(levels) < 2:
        return
    empty = min(levels.values(), key=abs)
    highest = float(np.quantile(np.abs(forces - empty), 0.99))
    if highest <= _ERRORS * search.noise.of(grip.force.name):
        return
    share = np.abs(forces - empty) / highest
    for stay in constant_runs(commands, times).spans():
        part, clock = share[stay.start : stay.stop], times[stay.start : stay.stop]
        held = runs_of(part >= _HOLDS, clock)
        held = held.only(held.durations_s >= HELD_S)
        if not len(held):
            continue
        last = int(held.stops[-1])
        rests = runs_of(part[last:] <= _EMPTY, clock[last:])
        rests = rests.only(rests.durations_s >= HELD_S)
        if len(rests):
            level = empty + float(np.median(part[held.starts[-1] : last])) * highest
            yield LostGrip(float(rests.starts_s[0]), stay.end_s, level, empty)


def _often(commands: Array) -> list[float]:
    """The values that a command has for long; of a command that goes on moving there are many."""
    values, counts = np.unique(commands, return_counts=True)
    return values[counts >= 0.02 * len(commands)].tolist()[:8]
