"""docs/standin.md lists what the stand-in has, and what is missing from it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import controller
from controller.surface import MEMBERS, Lacking, lacking

from docs import reference
from webots_mcp.standin.node_types import NODE_TYPES
from webots_mcp.standin.protos import BUILT_IN
from webots_mcp.standin.simulated_devices import DEVICES

PAGE = (Path(__file__).parents[2] / "docs" / "standin.md").read_text(encoding="utf-8")
HAD = {had.__name__ for had in controller.__all__}


def names_between(start: str, end: str) -> set[str]:
    return set(re.findall(r"`([^`]+)`", PAGE.partition(start)[2].partition(end)[0]))


def test_it_lists_every_node() -> None:
    assert names_between("### Nodes\n", "\n### ") == set(NODE_TYPES) - set(DEVICES)
    assert names_between("### PROTO nodes\n", "\n### ") == set(BUILT_IN)


def test_it_lists_every_device() -> None:
    assert set(re.findall(r"^- `(\w+)`: ", PAGE, re.M)) == set(DEVICES)


def test_it_lists_every_class_and_the_site_the_members_missing_from_it() -> None:
    assert names_between("The classes ", " have the") == HAD
    site = reference.stand_in()
    listed = dict(re.findall(r"(?m)^- `(\w+)`[^:]*: (.+)$", site))
    assert listed.keys() == HAD
    for name in HAD:
        missing = missing_members(name) - (
            missing_members("Robot") if name == "Supervisor" else set()
        )
        assert set(re.findall(r"`(\w+)`", listed[name])) == missing, name
    others = site.partition("and fail when used: ")[2]
    assert set(re.findall(r"`(\w+)`", others)) == set(MEMBERS) - HAD


def missing_members(name: str) -> set[str]:
    """The members of a class in Webots that the class of the stand-in does not have."""
    had: Any = getattr(controller, name)
    own: dict[str, Any] = {**vars(had)}
    return {member for member, value in own.items() if isinstance(value, Lacking)}


def test_it_shows_the_sentence_as_it_is() -> None:
    assert str(lacking("Node.addForce")) in PAGE
