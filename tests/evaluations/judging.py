"""Judges an answer by code: its values, what was sent to robots, and what the subject holds now."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final

from tests.evaluations.scenario import Check, Scenario
from tests.evaluations.subjects import Subject
from webots_mcp.database.connection import connect
from webots_mcp.questions import all_questions
from webots_mcp.standin import Simulation

_READING_ACTIONS: Final = ("get_scene", "get_field", "screenshot", "take_frame")
_STEERING_TOOLS: Final = {each.name for each in all_questions() if not each.effect.reads}


@dataclass(frozen=True)
class NotedCall:
    """A call of a tool, as the server saw it."""

    tool: str
    arguments: dict[str, Any]
    failed: bool
    tokens: int


def wrong_turns(calls: Sequence[NotedCall]) -> int:
    """Count calls that failed, and calls that repeat another one although nothing was steered."""
    count, made = 0, list[tuple[str, str]]()
    for call in calls:
        key = (call.tool, json.dumps(call.arguments, sort_keys=True))
        count += call.failed or key in made
        made = [] if call.tool in _STEERING_TOOLS and not call.failed else [*made, key]
    return count


def read_answer(said: Any) -> dict[str, Any] | None:
    """Return the last JSON object in what a client said; None without one.

    Envelopes of clients that wrap their answer (`structured_output`, `result`) are opened.
    """
    if isinstance(said, dict):
        if isinstance(said.get("structured_output"), dict):
            return said["structured_output"]
        if isinstance(said.get("result"), str):
            return read_answer(said["result"])
        return said
    if not isinstance(said, str):
        return None
    decoder, place, found = json.JSONDecoder(), said.find("{"), None
    while place >= 0:
        try:
            found, end = decoder.raw_decode(said, place)
        except ValueError:
            end = place + 1
        place = said.find("{", end)
    return read_answer(found)


def wrong_fields(scenario: Scenario, answer: dict[str, Any] | None) -> list[str]:
    """Return what is wrong with an answer, one text for each of its members."""
    if answer is None:
        return ["gave no JSON object"]
    names = [field.name for field in scenario.fields]
    extra = [f"has the unknown member {name!r}" for name in answer if name not in names]
    missing = [f"has no member {name!r}" for name in names if name not in answer]
    wrong = [
        f"says {field.name} = {answer[field.name]!r}; right is "
        + " or ".join(map(repr, field.right))
        for field in scenario.fields
        if field.name in answer and not field.accepts(answer[field.name])
    ]
    return [*extra, *missing, *wrong]


def wrong_effects(scenario: Scenario, subject: Subject) -> list[str]:
    """Return what is wrong with what was done: forbidden, left out, or in another order."""
    if not subject.file.exists():
        return []
    with closing(connect(subject.file, "reader")) as connection:
        sent = connection.execute(
            "SELECT action, status FROM command WHERE id > ? ORDER BY id",
            (subject.last_command_id,),
        ).fetchall()
        allowed = {*scenario.may, *scenario.order, *_READING_ACTIONS}
        wrong = [f"sent the forbidden {action}" for action, _ in sent if action not in allowed]
        done = iter([action for action, status in sent if status == "done"])
        if not all(action in done for action in scenario.order):
            wrong.append(f"did not do {', then '.join(scenario.order)}")
        for check in scenario.checks:
            found = (
                (connection.execute(check.sql).fetchone() or (None,))[0]
                if check.sql
                else _simulated(subject.simulation, check.path)
            )
            wrong += _violation(check, found)
    return wrong


def _violation(check: Check, found: Any) -> list[str]:
    return [] if check.accepts(found) else [f"{check.means}: not so, found {found!r}"]


def _simulated(simulation: Simulation | None, path: str) -> Any:
    """Return `mode`, `robot.NAME.ATTRIBUTE` or `field.DEF.FIELD.INDEX` of a simulation."""
    assert simulation is not None, "only a live scenario has a simulation"
    match path.split("."):
        case ["mode"]:
            return simulation.mode.name.lower()
        case ["robot", name, attribute]:
            return getattr(simulation.robot(name), attribute)
        case ["field", name, attribute, index]:
            nodes = simulation.simulator.world.nodes
            (node,) = [each for each in nodes if each.def_name == name]
            return node.fields[attribute][int(index)]
        case _:
            raise ValueError(f"a simulation has no {path!r}")
