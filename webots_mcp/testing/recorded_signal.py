"""A signal as a test sees it: every recorded value, and what it never may have been."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, Final

from webots_mcp.errors import NothingRecordedError
from webots_mcp.naming import Value
from webots_mcp.store.analysis.summary import LARGEST
from webots_mcp.store.reading.frame import Frame

_SHOWN_STATE_CHARACTERS: Final = 500


class RecordedSignal:
    """One signal of one run, row by row.

    A row is what one `publish` recorded: with a `throttle_interval` above 1 there is none for the
    calls in between. A row without a value counts as None: the signal was not in it, was None, or
    could not be held (NaN, infinity).
    """

    def __init__(
        self,
        name: str,
        run: str,
        frame: Frame,
        values: Sequence[Value],
        state_of: Callable[[int], str],
    ) -> None:
        """Made by `Recording.signal`.

        Args:
            name: Dotted.
            run: How messages name the run.
            frame: The rows of the run.
            values: Those of this signal, one for each row.
            state_of: The JSON text of the state row with that id.
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
        """The value in each row, in order."""
        return list(self._values)

    def times_s(self) -> list[float]:
        """The simulation time of each row, in seconds."""
        return list(self._times)

    def changes(self) -> list[Any]:
        """The values without those that equal the one before: `["cruise", "turn", "cruise"]`."""
        later = [after for before, after in pairwise(self._values) if after != before]
        return [*self._values[:1], *later]

    @property
    def first(self) -> Any:
        """The value in the first row."""
        return self._values[0]

    @property
    def last(self) -> Any:
        """The value in the newest row."""
        return self._values[-1]

    def min(self) -> float:
        """The smallest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return min(self._numbers())

    def max(self) -> float:
        """The largest number.

        Raises:
            NothingRecordedError: No row holds a number, or not all rows could be read.
        """
        return max(self._numbers())

    def at(self, time_s: float) -> Any:
        """The value in force at a simulation time: that of the newest row up to then.

        Raises:
            NothingRecordedError: The first row is younger.
        """
        row = sum(time <= time_s for time in self._times) - 1
        if row < 0:
            first_s = self._times[0]
            raise NothingRecordedError(
                f"{self._run} has no row up to {time_s:g} s: the first is at {first_s:g} s"
            )
        return self._values[row]

    def first_time_s(self, value: Value) -> float:
        """The simulation time of the first row with this value.

        Raises:
            NothingRecordedError: There is none; the text tells which values there are.
        """
        if value in self._values:
            return self._times[self._values.index(value)]
        seen = ", ".join(map(repr, list(dict.fromkeys(self._values))[:10]))
        raise NothingRecordedError(
            f"{self.name} was never {value!r} in the {len(self._values)} rows of {self._run}; "
            f"it was {seen}"
        )

    def duration_s(self, value: Value) -> float:
        """For how many simulated seconds it had this value; each row counts up to the next."""
        steps = pairwise(self._times)
        return sum(
            after_s - before_s
            for (before_s, after_s), held in zip(steps, self._values, strict=False)
            if held == value
        )

    def assert_never(self, value: Value) -> None:
        """Fail if a row holds this value.

        Raises:
            AssertionError: With when, how often, and the whole state at the first time.
        """
        bad = [row for row, held in enumerate(self._values) if held == value]
        self._fail_at(bad, f"was {value!r}", bad[0] if bad else 0)

    def assert_never_below(self, limit: float) -> None:
        """Fail if a row holds a number under the limit, or none holds a number.

        Raises:
            AssertionError: With when, how often, how far, and the whole state at the first time.
        """
        self._assert_each(lambda number: number < limit, f"fell below {limit:g}", min)

    def assert_never_above(self, limit: float) -> None:
        """Fail if a row holds a number over the limit, or none holds a number.

        Raises:
            AssertionError: With when, how often, how far, and the whole state at the first time.
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
        """The numbers by their rows, flags as 0 and 1; not NaN, nor beyond 1e100."""
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
