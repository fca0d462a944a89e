"""What a labelled recording is: rows as a robot publishes them, and what truly happened in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Measure = Literal["standstill", "stuck", "missing", "flat", "dropout", "leap", "swing", "gap"]


class Setting(NamedTuple):
    """What recordings are drawn with where it is not to be drawn.

    Attributes:
        noise: The place of the noise in the levels that each kind of value has.
    """

    interval_s: float
    noise: int


SETTING: Final[ContextVar[Setting | None]] = ContextVar("setting", default=None)


def interval_of(rng: np.random.Generator, intervals_s: Sequence[float]) -> float:
    """One of these row intervals, or that of the setting; what is drawn after it is the same."""
    drawn_s, setting = float(rng.choice(intervals_s)), SETTING.get()
    return setting.interval_s if setting else drawn_s


def noise_of(drawn: float, levels: Sequence[float]) -> float:
    """The noise that was drawn, or that of the setting."""
    return levels[setting.noise] if (setting := SETTING.get()) else drawn


@dataclass(frozen=True)
class Incident:
    """Something that truly happened, known from how the recording was made.

    Attributes:
        name: The published signal that it is about; None where it is about the robot.
        amplitude: Half of the way from one extreme to the other.
        begin_error_s: Standard deviation that no unbiased estimate of its begin falls below;
            `end_error_s` of its end.
        optional: It lies at the limit of what counts, so that an answer may tell it or not.
        split: It is cut in two by a recording gap, so that an answer may tell it twice.
    """

    measure: Measure
    start_s: float
    end_s: float
    name: str | None = None
    period_s: float | None = None
    amplitude: float | None = None
    begin_error_s: float = 0.0
    end_error_s: float = 0.0
    optional: bool = False
    split: bool = False


@dataclass(frozen=True)
class LabelledRun:
    """The rows of one run, evenly recorded but for gaps, and their truth.

    Attributes:
        times: Simulation time of each row.
        columns: One value per row of what is published under each name; NaN where a device gave
            it, None where it had no value.
        noise_m: Standard deviation of the noise in each coordinate of the position.
        distance_m: Travelled; None where no position is published.
    """

    times: Array
    columns: dict[str, Sequence[Any]]
    interval_s: float
    incidents: tuple[Incident, ...] = ()
    noise_m: float = 0.0
    distance_m: float | None = None

    @property
    def duration_s(self) -> float:
        """From the first row to the last."""
        return float(self.times[-1] - self.times[0])

    def kept(self, rows: Flags) -> LabelledRun:
        """Only the rows that are marked; what happened stays."""
        places = np.flatnonzero(rows).tolist()
        columns = {name: [values[at] for at in places] for name, values in self.columns.items()}
        return replace(self, times=self.times[rows], columns=columns)


@dataclass(frozen=True)
class Case:
    """A recording of one robot: a run, and those before the resets that led to it.

    Attributes:
        number: The same kind, seed and number draw the same case.
        asked: What is looked for in it.
    """

    kind: str
    number: int
    runs: tuple[LabelledRun, ...]
    asked: tuple[Measure, ...]


def cut_at(run: LabelledRun, time_s: float) -> LabelledRun:
    """What was recorded until then; what was going on may be told or not."""
    incidents = tuple(
        each
        if each.end_s < time_s - run.interval_s
        else replace(each, end_s=min(each.end_s, time_s), optional=True)
        for each in run.incidents
        if each.start_s < time_s
    )
    return replace(run.kept(run.times < time_s), incidents=incidents)


def repeated(run: LabelledRun, least_rows: int) -> LabelledRun:
    """The run forwards, backwards, forwards again and so on, until it has so many rows.

    Where it turns round every value goes on without a step, and all that happened happens again.
    """
    copies = -(-least_rows // len(run.times))
    backwards = _reversed(run)
    parts = [backwards if index % 2 else run for index in range(copies)]
    pitch_s = run.duration_s + run.interval_s
    times = np.concatenate([part.times + pitch_s * at for at, part in enumerate(parts)])
    columns = {
        name: [value for part in parts for value in part.columns[name]] for name in run.columns
    }
    shifted = [
        _shifted(each, pitch_s * at) for at, part in enumerate(parts) for each in part.incidents
    ]
    way_m = None if run.distance_m is None else copies * run.distance_m
    joined = tuple(_joined(shifted, 1.5 * run.interval_s))
    return replace(run, times=times, columns=columns, incidents=joined, distance_m=way_m)


def _reversed(run: LabelledRun) -> LabelledRun:
    ends_s = float(run.times[0] + run.times[-1])
    return replace(
        run,
        times=ends_s - run.times[::-1],
        columns={name: list(values)[::-1] for name, values in run.columns.items()},
        incidents=tuple(
            replace(
                each,
                start_s=ends_s - each.end_s,
                end_s=ends_s - each.start_s,
                begin_error_s=each.end_error_s,
                end_error_s=each.begin_error_s,
            )
            if each.measure != "leap"
            else _shifted(each, ends_s + run.interval_s - 2 * each.start_s)
            for each in run.incidents
        ),
    )


def _shifted(incident: Incident, by_s: float) -> Incident:
    return replace(incident, start_s=incident.start_s + by_s, end_s=incident.end_s + by_s)


def _joined(incidents: Iterable[Incident], within_s: float) -> list[Incident]:
    """Those of one thing that touch as one: it went on where the recording turns round."""
    found: list[Incident] = []
    for incident in sorted(incidents, key=lambda each: each.start_s):
        alike = (
            index
            for index, each in enumerate(found)
            if (each.measure, each.name) == (incident.measure, incident.name)
            and incident.start_s - each.end_s <= within_s
            and each.end_s > each.start_s
        )
        if (index := next(alike, None)) is None:
            found.append(incident)
        else:
            optional = found[index].optional and incident.optional
            ends = {"end_s": incident.end_s, "end_error_s": incident.end_error_s}
            found[index] = replace(found[index], **ends, optional=optional)
    return found
