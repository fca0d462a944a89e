"""A signal as a test sees it: each recorded value, and assertions about all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Final

from webots_mcp.analysis.summary import LARGEST
from webots_mcp.errors import NothingRecordedError
from webots_mcp.signals.naming import Value
from webots_mcp.store.reading.frame import Frame

_SHOWN_STATE_CHARACTERS: Final = 500


class RecordedSignal:
    """One signal of one run, row by row.

    A row is what one call of `publish` recorded. With a `throttle_interval` above 1, the calls in
    between have no row. The value of a row is None if the signal was missing from it, was None, or
    could not be stored (NaN, infinity).
    """

    def __init__(
        self,
        name: str,
        run: str,
        frame: Frame,
        values: Sequence[Value],
        state_of: Callable[[int], str],
    ) -> None:
        """Made by `RobotRecording.signal`.

        Args:
            name: Dotted name of the signal.
            run: The run, as messages name it.
            frame: The rows of the run.
            values: The value of this signal in each row.
            state_of: Returns the JSON text of the state row with an id.
        """
        self.name = name
        self._run = run
        self._unread = "; ".join(map(str, frame.unread_of(name)))
        self._times: list[float] = frame.times.tolist()
        self._ids: list[int] = frame.ids.tolist()
        self._values = values
        self._state_of = state_of

    def __repr__(self) -> str:
        return f"<signal {self.name!r} of {self._run}: {len(self._values)} rows>"

    def values(self) -> list[Any]:
        """Return the value in each row, in order."""
        return list(self._values)

    def times_s(self) -> list[float]:
        """Return the simulation time of each row, in seconds."""
        return list(self._times)

    def changes(self) -> list[Any]:
        """Return the values without repetitions: `["cruise", "turn", "cruise"]`."""
        later = [after for before, after in pairwise(self._values) if after != before]
        return [*self._values[:1], *later]

    @property
    def first(self) -> Any:
        """Return the value in the first row."""
        return self._values[0]

    @property
    def last(self) -> Any:
        """Return the value in the newest row."""
        return self._values[-1]

    def min(self) -> float:
        """Return the smallest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return min(self._numbers())

    def max(self) -> float:
        """Return the largest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return max(self._numbers())

    def at(self, time_s: float) -> Any:
        """Return the value at a simulation time: that of the newest row up to then.

        Raises:
            NothingRecordedError: The first row is later.
        """
        row = sum(time <= time_s for time in self._times) - 1
        if row < 0:
            first_s = self._times[0]
            raise NothingRecordedError(
                f"{self._run} has no row up to {time_s:g} s: the first is at {first_s:g} s"
            )
        return self._values[row]

    def first_time_s(self, value: Value) -> float:
        """Return the simulation time of the first row with this value.

        Raises:
            NothingRecordedError: There is none. The text lists the values that there are.
        """
        if value in self._values:
            return self._times[self._values.index(value)]
        seen = ", ".join(map(repr, list(dict.fromkeys(self._values))[:10]))
        raise NothingRecordedError(
            f"{self.name} was never {value!r} in the {len(self._values)} rows of {self._run}; "
            f"it was {seen}"
        )

    def duration_s(self, value: Value) -> float:
        """Return how many simulated seconds it had this value. Each row counts up to the next."""
        steps = pairwise(self._times)
        return sum(
            after_s - before_s
            for (before_s, after_s), held in zip(steps, self._values, strict=False)
            if held == value
        )

    def assert_never(self, value: Value) -> None:
        """Fail if a row holds this value.

        Raises:
            AssertionError: A row does. The text has the time, the count and the first state.
        """
        bad = [row for row, held in enumerate(self._values) if held == value]
        self._fail_at(bad, f"was {value!r}", bad[0] if bad else 0)

    def assert_never_below(self, limit: float) -> None:
        """Fail if a row holds a number under the limit, or none holds a number.

        Raises:
            AssertionError: A row does. The text has times, count, extreme and the first state.
        """
        self._assert_each(lambda number: number < limit, f"fell below {limit:g}", min)

    def assert_never_above(self, limit: float) -> None:
        """Fail if a row holds a number over the limit, or none holds a number.

        Raises:
            AssertionError: A row does. The text has times, count, extreme and the first state.
        """
        self._assert_each(lambda number: number > limit, f"rose above {limit:g}", max)

    def _assert_each(
        self,
        is_bad: Callable[[float], bool],
        what: str,
        worst_of: Callable[[list[float]], float],
    ) -> None:
        numbers = self._usable
        if not numbers:
            raise AssertionError(f"{self._no_number()}, so nothing shows that it never {what}")
        bad = {row: number for row, number in numbers.items() if is_bad(number)}
        worst = worst_of(list(bad.values())) if bad else 0.0
        self._fail_at(list(bad), what, next((row for row in bad if bad[row] == worst), 0))

    def _fail_at(self, bad: Sequence[int], what: str, worst: int) -> None:
        if not bad and self._unread:
            raise AssertionError(
                f"{self.name} of {self._run} was {self._unread}: nothing shows that it never {what}"
            )
        if not bad:
            return
        times, values, first = self._times, self._values, bad[0]
        lines = [f"{self.name} {what} in {len(bad)} of {len(values)} rows of {self._run}"]
        lines += [f"first at {times[first]:g} s: {_shown(values[first])}"]
        if worst != first:
            lines += [f"furthest at {times[worst]:g} s: {_shown(values[worst])}"]
        state = self._state_of(self._ids[first])
        cut = " ..." if len(state) > _SHOWN_STATE_CHARACTERS else ""
        lines += [f"the state at {times[first]:g} s: {state[:_SHOWN_STATE_CHARACTERS]}{cut}"]
        raise AssertionError("\n  ".join(lines))

    def _numbers(self) -> Sequence[float]:
        numbers = self._usable
        if not numbers or self._unread:
            why = f"{self.name} of {self._run} was {self._unread}" if numbers else self._no_number()
            raise NothingRecordedError(why)
        return list(numbers.values())

    @property
    def _usable(self) -> dict[int, float]:
        """Return the numbers by row, flags as 0 and 1, without NaN and numbers above 1e100."""
        return {
            row: float(value)
            for row, value in enumerate(self._values)
            if isinstance(value, int | float) and abs(value) <= LARGEST
        }

    def _no_number(self) -> str:
        why = f" ({self._unread})" if self._unread else ""
        rows = f"the {len(self._values)} rows of {self._run}"
        return f"{self.name} holds no number in {rows}{why}"


def _shown(value: Value) -> str:
    return f"{value:.6g}" if isinstance(value, float) else repr(value)
