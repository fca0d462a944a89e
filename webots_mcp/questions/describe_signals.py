"""What signals mean: listed with the source of each meaning, declared, and undone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

from pydantic import Field

from webots_mcp.answers.answer_models import SignalMeaningsAnswer
from webots_mcp.answers.budget import fitting, short_name, some, without_empty
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.arguments import LONGEST_NAME, AnyNames, RobotName
from webots_mcp.questions.declaration import CHANGES, READS, question
from webots_mcp.signals.meaning import (
    DECLARED_WORDS,
    Meaning,
    Quantity,
    Role,
    declaration_of,
    declare_meaning,
)
from webots_mcp.store.meanings import meanings_of, set_meanings, undo_meanings
from webots_mcp.store.reading.catalogue import catalogue, resolve_signals
from webots_mcp.store.recording import RecordingAccess, RobotView
from webots_mcp.store.registered_signals import RegisteredSignal

MEANING_COLUMNS: Final = (
    "signal", "quantity", "role", "unit", "side", "target_of", "same_as", "low", "high", "source",
    "why",
)  # fmt: skip
_NOT_YET: Final = (
    "No signal has been recorded yet. Run the simulation first, then describe its signals."
)
_DECLARE: Final = (
    "signals of unknown meaning are not judged: declare them with {}; " + DECLARED_WORDS
)

_UNITS_OF: Final[dict[tuple[Quantity, ...], tuple[str, ...]]] = {
    ("x", "y", "height", "distance"): ("m", "cm", "mm", "km"),
    ("heading", "roll", "pitch", "angle"): ("rad", "deg"),
    ("speed",): ("m/s", "km/h", "mm/s", "cm/s"),
    ("turn rate", "angular velocity"): ("rad/s", "deg/s", "rpm"),
    ("voltage",): ("V", "mV"),
    ("current",): ("A", "mA"),
    ("temperature",): ("degC", "K"),
}
_Name = Annotated[str, Field(max_length=LONGEST_NAME)]


@question("List meanings", READS, quotes=True, tier="all")
def webots_list_meanings(
    recording: RecordingAccess, signals: AnyNames = None, robot: RobotName = None
) -> SignalMeaningsAnswer:
    """Show what each signal is taken to mean, how that is known, and which signals are unknown.

    To correct a meaning use webots_describe_signals; for values and ranges use
    webots_list_signals.
    """
    with recording.view(robot) as view:
        return SignalMeaningsAnswer(
            **view.header(), **_listed(view, signals, None, is_undone=False)
        )


@question("Describe signals", CHANGES, quotes=True, tier="core")
def webots_describe_signals(
    recording: RecordingAccess,
    signals: Annotated[
        list[_Name] | None,
        Field(max_length=50, description="Signals to describe; '*' means any text. Default: all."),
    ] = None,
    quantity: Annotated[
        Quantity | None,
        Field(description="What it measures or sets. motor speed is of motors other than wheels."),
    ] = None,
    role: Annotated[
        Role | None,
        Field(description="Whether it is a measurement, a command, a target or a limit."),
    ] = None,
    unit: Annotated[str | None, Field(max_length=20, description="Unit, such as 'm/s'.")] = None,
    target_of: Annotated[
        _Name | None, Field(description="Name of the measured signal whose target it is.")
    ] = None,
    same_as: Annotated[
        _Name | None, Field(description="Name of another signal that measures the same.")
    ] = None,
    side: Annotated[
        str | None, Field(max_length=20, description="Part of the robot, such as 'front left'.")
    ] = None,
    low: Annotated[float | None, Field(description="Lowest value the signal can have.")] = None,
    high: Annotated[float | None, Field(description="Highest value the signal can have.")] = None,
    undo: Annotated[
        bool, Field(description="Remove the declarations of these signals instead.")
    ] = False,
    robot: RobotName = None,
) -> SignalMeaningsAnswer:
    """Declare what signals mean, so that webots_find_events and webots_check_run can judge them.

    Signals of unknown meaning are never judged: declare them before you ask for checks. A
    declaration also applies to earlier runs, and replaces the previous one. Given only signals or
    nothing, it lists what each signal is taken to mean and why.
    """
    said: dict[str, Any] = {
        "quantity": quantity, "role": role, "unit": unit, "target_of": target_of,
        "same_as": same_as, "side": side, "low": low, "high": high,
    }  # fmt: skip
    declares = any(value is not None for value in said.values())
    if (declares or undo) and not signals:
        raise InvalidInputError(
            "signals is missing. Give names of recorded signals; webots_list_signals lists them."
        )
    if declares and undo:
        raise InvalidInputError(
            "undo=true removes a description, so it excludes quantity, role, unit and the others. "
            "Leave either undo or those out."
        )
    changed: list[str] | None = None
    if declares:
        changed = _declare(recording, robot, signals or [], said)
    elif undo:
        changed = _undo(recording, robot, signals or [])
    with recording.view(robot) as view:
        return SignalMeaningsAnswer(
            **view.header(), **_listed(view, signals, changed, is_undone=undo)
        )


def _declare(
    recording: RecordingAccess, robot: str | None, names: Sequence[str], said: Mapping[str, Any]
) -> list[str]:
    """Store the declaration for each signal that the names mean; return those signals."""
    with recording.view(robot) as view:
        robot_id, known = view.robot.id, _known(view)
        if not known:
            raise InvalidInputError(_NOT_YET)
        meant = [each.name for each in resolve_signals(known, names)]
        partners = [said[field] for field in ("target_of", "same_as") if said[field] is not None]
        if partners:
            resolve_signals(known, partners)
    try:
        declared = [declare_meaning(name, **said) for name in meant]
    except ValueError as error:
        raise InvalidInputError(str(error)) from error
    with recording.writer() as connection:
        set_meanings(connection, robot_id, declared, recording.asker)
    return meant


def _undo(recording: RecordingAccess, robot: str | None, names: Sequence[str]) -> list[str]:
    with recording.view(robot) as view:
        robot_id = view.robot.id
    with recording.writer() as connection:
        return undo_meanings(connection, robot_id, names)


def _known(view: RobotView) -> dict[str, RegisteredSignal]:
    """All signals of the robot, also those of earlier runs; none before anything was recorded."""
    return catalogue(view.connection, view.subject) if view.run is not None else {}


def _listed(
    view: RobotView, names: Sequence[str] | None, changed: Sequence[str] | None, *, is_undone: bool
) -> dict[str, Any]:
    known = _known(view)
    meanings = meanings_of(known)
    if is_undone:  # what was undone may have been declared of names that were never recorded
        shown = [name for name in changed or () if name in known]
    elif names is None:
        shown = sorted(known)
    else:
        shown = sorted(each.name for each in resolve_signals(known, names)) if known else []
    rows = fitting([_meaning_row(name, meanings[name]) for name in shown]) if shown else []
    unknown = [n for n in shown if known[n].is_number and meanings[n].quantity is None]
    hints = [_DECLARE.format(declaration_of(name)) for name in unknown[:1]]
    if len(rows) < len(shown):
        hints.append(f"{len(rows)} of {len(shown)} are shown: narrow signals, such as ['motors.*']")
    return {
        "signals": without_empty(MEANING_COLUMNS, rows),
        "total": len(shown),
        "unknown": [some(unknown)] if unknown else None,
        "changed": [some(changed)] if changed else None,
        "notes": None
        if is_undone or not changed
        else _unlike_units(known, meanings, shown) or None,
        "hint": "; ".join(hints) or (None if known else _NOT_YET),
    }


def _unlike_units(
    known: Mapping[str, RegisteredSignal], meanings: Mapping[str, Meaning], names: Sequence[str]
) -> list[str]:
    """Return of each signal with a unit of something else than its quantity that this is so."""
    found: list[str] = []
    for name in names:
        quantity, unit = meanings[name].quantity, meanings[name].unit or known[name].unit
        fitting_units = next((units for of, units in _UNITS_OF.items() if quantity in of), None)
        others = {each for units in _UNITS_OF.values() for each in units}
        if fitting_units is not None and unit in others - set(fitting_units):
            found.append(f"{name} is in {unit}, which is no unit of {quantity}")
    return found


def _meaning_row(name: str, meaning: Meaning) -> list[Any]:
    return [
        short_name(name),
        *(getattr(meaning, column) for column in MEANING_COLUMNS[1:-1]),
        meaning.why,
    ]
