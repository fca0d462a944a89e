"""Numbers, times, values and events as the texts of a report."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Any, Final, cast

from webots_mcp.judging.detection.event import Event
from webots_mcp.judging.detection.jump import JUMP

LONGEST_TEXT: Final = 1_000
"""Characters of a cell."""
_LONGEST_VALUE: Final = 400
"""Characters of a value within a cell."""
_RELATIVE_ZERO: Final = 1e-9
"""Fraction of a signal's range below which a number is a rounding error."""
_HIDDEN_DETAILS: Final = ("id", "image_id", "first_times_s")


def cut(text: str, longest: int = LONGEST_TEXT) -> str:
    """Return a text; if it is too long, its beginning and its length."""
    if len(text) <= longest:
        return text
    return f"{text[:longest]} … ({len(text)} characters)"


def capitalised(text: str) -> str:
    """Return a text with a capital letter at its start; the rest stays as it is."""
    return f"{text[:1].upper()}{text[1:]}"


def number(value: float | None, span: float = 0.0) -> str:
    """Return a number with four digits, or an empty text for None.

    Args:
        value: The number.
        span: Range of its signal. A number that is negligible compared with it becomes 0.
    """
    if value is None:
        return ""
    is_nothing = abs(value) <= _RELATIVE_ZERO * span < math.inf
    return f"{0.0 if is_nothing else value:.4g}"


def pace_text(factor: float) -> str:
    """Return the speed of simulation time in words."""
    text = f"{factor:.2g}"
    return "at the pace of real time" if text == "1" else f"at {text} times real time"


def time_at(time_s: float | None) -> str:
    """Return a simulation time to the millisecond."""
    return "" if time_s is None else f"{time_s:.3f}"


def length(duration_s: float) -> str:
    """Return a duration: 12.3 s, 4 min 5 s, 2 h 3 min."""
    if duration_s < 120:
        return f"{duration_s:.3g} s"
    minutes, rest_s = divmod(round(duration_s), 60)
    if minutes < 120:
        return f"{minutes} min {rest_s} s"
    return f"{minutes // 60} h {minutes % 60} min"


def clock(wall_time_s: float) -> str:
    """Return a wall time in UTC, which is unambiguous wherever the file is read."""
    moment = datetime.fromtimestamp(wall_time_s, timezone.utc)
    return moment.strftime("%Y-%m-%d %H:%M:%S UTC")


def size(size_bytes: int) -> str:
    """Return the size of a file."""
    return f"{size_bytes / 1e6:.{1 if size_bytes >= 1e6 else 2}f} MB"


def share(part: float, whole: float) -> str:
    """Return a part as a percentage."""
    return f"{100 * part / whole:.3g} %" if whole > 0 else ""


def counted(count: int, what: str) -> str:
    """Return a count with its noun: 1 event, 2 events."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")


def format_value(value: Any) -> str:
    """Return a value of any type in one line."""
    if value is None:
        return "null"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, str):
        return cut(value, _LONGEST_VALUE)
    return cut(json.dumps(_rounded(value), ensure_ascii=False, default=str), _LONGEST_VALUE)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(number(value))
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in cast("dict[str, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(each) for each in cast("list[Any]", value)]
    return value


def format_named_values(values: Mapping[str, Any]) -> str:
    """Return named values in one line. A unit at the end of a name follows its value."""
    return "; ".join(_named(name, value) for name, value in values.items())


def format_signal_values(values: Mapping[str, Any]) -> str:
    """Return values of signals or parameters in one line, with their full names."""
    return ", ".join(f"{name} {format_value(value)}" for name, value in values.items())


def _named(name: str, value: Any) -> str:
    found = re.fullmatch(r"(.+)_(s|m|rad)", name)
    if isinstance(value, str) and " " in value:
        return f"{name.replace('_', ' ')}: {format_value(value)}"
    if found is None or not isinstance(value, (int, float)):
        return f"{name.replace('_', ' ')} {format_value(value)}"
    return f"{found[1].replace('_', ' ')} {format_value(value)} {found[2]}"


def describe_event(event: Event) -> str:
    """Return what happened, without the time."""
    if event.count > 1:
        return _describe_many(event)
    return cut(_WORDS.get(event.kind, _describe_others)(event))


def _describe_many(event: Event) -> str:
    details = {name: each for name, each in event.details.items() if name not in _HIDDEN_DETAILS}
    says = details.pop("says", f"{event.count} times {event.kind}")
    of = f"{event.name}: " if event.name else ""
    return cut("; ".join(filter(None, (f"{of}{says}", format_named_values(details)))))


def _describe_change(event: Event) -> str:
    before, after = event.details["before"], event.details["after"]
    return f"{event.name}: {format_value(before)} → {format_value(after)}"


def _describe_log(event: Event) -> str:
    return f"{event.name} ({event.details['source']}): {event.details['message']}"


def _describe_command(event: Event) -> str:
    details = dict(event.details)
    params = format_signal_values(details.get("params") or {})
    outcome = details["status"]
    if "took_wall_s" in details:
        outcome += f" after {length(details['took_wall_s'])} of wall time"
    outcome += f", answer {format_value(details['result'])}" if details.get("result") else ""
    outcome += f", {details['error']}" if details.get("error") else ""
    return f"{event.name}({params}): {outcome}"


def _describe_run(event: Event) -> str:
    return f"the run {event.details['what']} ({event.details['reason'] or 'unknown cause'})"


def _describe_noticed(event: Event) -> str:
    name = f" {event.name}" if event.name else ""
    data = event.details.get("data")
    said = (
        format_named_values(cast("dict[str, Any]", data))
        if isinstance(data, dict)
        else format_value(data)
    )
    return f"{event.details['what']}{name}" + (f": {said}" if data else "")


def _describe_image(event: Event) -> str:
    return f"picture of {event.name or 'the main view'}"


def _describe_gap(event: Event) -> str:
    usual_s = event.details.get("usual_interval_s")
    return "no rows" + (f", else one each {number(usual_s)} s" if usual_s else "")


def _describe_others(event: Event) -> str:
    details = {name: each for name, each in event.details.items() if name not in _HIDDEN_DETAILS}
    said = [str(details.pop("says"))] if "says" in details else []
    said += [format_named_values(details)] if details else []
    return ": ".join(filter(None, (event.name, "; ".join(said))))


def _describe_fall(event: Event) -> str:
    tilted = f"tilted by {format_value(event.details.get('tilt_deg'))}°"
    tilted += f" ({event.details['direction']})" if "direction" in event.details else ""
    who = f"{event.name} " if event.name else ""
    after = "got up again" if event.details.get("got_up") else "stayed down"
    return f"{who}fell: {tilted}, {after}"


def _describe_stay(event: Event) -> str:
    """Return where it stood, and what says that it should have moved."""
    details = event.details
    place = ", ".join(
        f"{axis} {format_value(details[f'{axis}_m'])} m" for axis in "xyz" if f"{axis}_m" in details
    )
    what = "did not move" if event.kind == "stuck" else "stood still"
    said = f"{what} at {place}" if place else what
    if details.get("evidence_for"):
        said += f"; evidence that it should have moved: {details['evidence_for']}"
    against = details.get("evidence_against")
    return f"{said}; evidence against: {against}" if against else said


def _describe_jump(event: Event) -> str:
    details = event.details
    if not {"before", "after"} <= details.keys():  # several items of an array, to other values
        return _describe_others(event)
    before, after = format_value(details["before"]), format_value(details["after"])
    back = f", then back to {format_value(details['back'])}" if "back" in details else ""
    return f"{event.name}: {before} → {after}{back}"


_WORDS: Final[Mapping[str, Callable[[Event], str]]] = {
    "change": _describe_change,
    "log": _describe_log,
    "command": _describe_command,
    "run": _describe_run,
    "bridge_event": _describe_noticed,
    "image": _describe_image,
    "gap": _describe_gap,
    "fall": _describe_fall,
    "stuck": _describe_stay,
    "standstill": _describe_stay,
    JUMP.name: _describe_jump,
}
