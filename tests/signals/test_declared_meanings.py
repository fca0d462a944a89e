"""What may be declared of a signal, and what counts where several sources say something."""

from __future__ import annotations

import math
from typing import Any

import pytest

from webots_mcp.signals.meaning import (
    DeclaredMeaning,
    Source,
    StatedMeaning,
    declare_meaning,
    fits_pattern,
    meaning_by_name,
    meaning_stated,
    targets_in,
)


def stated(source: Source = "declared", **said: Any) -> StatedMeaning:
    return StatedMeaning(declare_meaning("s", **said), source, f"said by {source}")


@pytest.mark.parametrize(
    ("given", "allowed"),
    [
        ({}, "Nothing is declared for signal 's'. Give one or more of quantity, role"),
        ({"quantity": "velocity"}, "quantity cannot be 'velocity'. Use one of x, y, height"),
        ({"quantity": []}, "quantity cannot be []"),
        ({"role": "actual"}, "Use one of measured, commanded, target, limit"),
        ({"side": "up"}, "Use one of left, right, front, rear, front left"),
        ({"unit": 3}, "unit must be a text of up to 20 characters, such as 'm/s', not 3"),
        ({"unit": ""}, "unit must be a text"),
        ({"unit": "m" * 21}, "unit must be a text"),
        ({"target_of": "s"}, "target_of must be the name of one other signal"),
        ({"same_as": "b.*"}, "same_as must be the name of one other signal"),
        ({"same_as": 3}, "same_as must be the name of a signal, such as 'motors.left', not 3"),
        ({"low": "0"}, "low must be a finite number, not '0'"),
        ({"high": True}, "high must be a finite number, not True"),
        ({"high": math.inf}, "high must be a finite number, not inf"),
        ({"low": 10**400}, "low must be a finite number"),
        ({"low": 2, "high": 1}, "low=2 is greater than high=1"),
        ({"name": "", "unit": "m"}, "name must be the name of a signal"),
        ({"name": 3, "unit": "m"}, "name must be the name of a signal, such as 'motors.left'"),
        ({"name": "x" * 501, "unit": "m"}, "name must be the name of a signal"),
        ({"quantiy": "speed"}, "unknown field 'quantiy' of signal 's'. Fields: quantity, role"),
    ],
)
def test_a_wrong_declaration_is_refused_with_what_is_allowed(
    given: dict[str, Any], allowed: str
) -> None:
    with pytest.raises(ValueError, match=r"[Ss]ignal|name") as raised:
        declare_meaning(given.pop("name", "s"), **given)
    assert allowed in str(raised.value)


def test_none_says_nothing_and_numbers_become_floats() -> None:
    assert declare_meaning("u", role="commanded", unit=None, low=-1, high=1) == DeclaredMeaning(
        "u", role="commanded", low=-1.0, high=1.0
    )


@pytest.mark.parametrize(
    ("pattern", "name", "fits"),
    [
        ("motors.*", "motors.left", True),
        ("motors.*", "motors", False),
        ("*.pos", "arm.elbow.pos", True),
        ("a*a", "a", False),
        ("q.?", "q.1", False),
        ("q", "q", True),
        ("*a*a*a*a*a*a*a*a*b", "a" * 500, False),
    ],
)
def test_a_star_is_any_text(pattern: str, name: str, fits: bool) -> None:
    assert fits_pattern(pattern, name) is fits


def test_a_declaration_gives_a_name_that_says_nothing_a_meaning() -> None:
    named = meaning_by_name("u", "num")
    found = meaning_stated("u", [stated(quantity="speed", role="commanded", unit="m/s")], named)
    assert (found.quantity, found.role, found.unit) == ("speed", "commanded", "m/s")
    assert (found.source, found.is_firm, found.why) == ("declared", True, "said by declared")


def test_each_field_is_that_of_the_strongest_source_that_says_it() -> None:
    sources = [stated(side="left"), stated("device", quantity="wheel speed", low=-6, high=6)]
    found = meaning_stated("a_rad_s", sources, meaning_by_name("a_rad_s", "num"))
    assert (found.side, found.quantity, found.low, found.high) == ("left", "wheel speed", -6, 6)
    assert (found.unit, found.source) == ("rad/s", "device")


def test_limits_and_roles_of_another_quantity_do_not_count() -> None:
    device = stated("device", quantity="joint position", role="measured", low=-1, high=1)
    named = meaning_by_name("arm_target", "num")
    found = meaning_stated("arm_target", [stated(quantity="force"), device], named)
    assert (found.quantity, found.role, found.low) == ("force", "target", None)


def test_what_nothing_says_a_quantity_of_stays_unknown_whatever_else_is_said() -> None:
    found = meaning_stated("u", [stated(unit="V", role="commanded")], meaning_by_name("u", "num"))
    assert (found.quantity, found.role, found.unit) == (None, "commanded", "V")


def test_declared_targets_are_pairs_and_what_is_the_same_shares_the_target() -> None:
    names = ("a", "b", "c")
    meanings = {name: meaning_by_name(name, "num", names=names) for name in names}
    meanings["a"] = meaning_stated("a", [stated(target_of="b")], meanings["a"])
    assert targets_in(meanings) == [("b", "a")]
    meanings["c"] = meaning_stated("c", [stated(same_as="b")], meanings["c"])
    assert sorted(targets_in(meanings)) == [("b", "a"), ("c", "a")]
