"""What a tab is asked to show."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Choice:
    """What the controls of a tab say.

    Attributes:
        robot: None for the only one, or the first of those that live.
        run_id: None for the newest run, whichever that is.
        beside_id: A run that is laid over the other; None for none.
        names: Signals; None for those that changed most.
        window_s: The last so many simulated seconds; None for the whole run.
    """

    robot: str | None = None
    run_id: int | None = None
    beside_id: int | None = None
    names: tuple[str, ...] | None = None
    window_s: float | None = None
