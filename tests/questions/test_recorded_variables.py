"""A path in the variables that were recorded at an event."""

from __future__ import annotations

from typing import Any

import pytest

from webots_mcp.database.secret_names import LEFT_OUT
from webots_mcp.errors import InvalidInputError
from webots_mcp.questions.recorded_variables import find_recorded

FRAMES: list[dict[str, Any]] = [
    {
        "at": "nav.py:12",
        "variables": {
            "error": 0.25,
            "self": {
                "<class>": "Navigator",
                "pid": {"<class>": "PID", "integral": 1.5, "gains": [1.0, 2.0, "... 9 in all"]},
                "api_key": LEFT_OUT,
                "map": "<array 9 x 9 of float64>",
                "queue": {"<class>": "Queue", "<items>": [3, 4]},
                "...": "30 in all",
            },
            "here": "(the same as self.pid)",
            "robot": "(the same as above)",
        },
    },
    {
        "at": "main.py:40",
        "variables": {"nav": "(the same as self)", "robot": {"<class>": "Robot", "name": "r"}},
    },
]


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        ("error", 0.25, "nav.py:12"),
        (" self.pid.integral", 1.5, "nav.py:12"),
        ("self.pid.gains[1]", 2.0, "nav.py:12"),
        ("self['pid'].integral", 1.5, "nav.py:12"),
        ("self.queue[1]", 4, "nav.py:12"),
        ("here.integral", 1.5, "nav.py:12"),
        ("nav.pid.gains[0]", 1.0, "nav.py:12"),
        ("robot.name", "r", "main.py:40"),
    ],
)
def test_a_path_leads_to_the_value_that_was_recorded(path: str, value: Any, line: str) -> None:
    found = find_recorded(path, FRAMES)
    assert (found.path, found.value, found.line) == (path.strip(), value, line)


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("errors", "no variable 'errors' was recorded at this event; recorded: error, self"),
        ("self.pod", "'pod' of self was not recorded; recorded of it: pid, api_key, map, queue"),
        ("self.pid.gains[7]", "of self.pid.gains the first 2 items were recorded"),
        ("self.pid.gains['x']", "of self.pid.gains only this was recorded"),
        ("self.map[0]", "of self.map only this was recorded: <array 9 x 9 of float64>"),
        ("self.api_key", "looks secret"),
        ("1 + 1", "does not begin with the name of a variable"),
    ],
)
def test_what_was_not_recorded_is_said_with_what_was(path: str, why: str) -> None:
    with pytest.raises(InvalidInputError) as caught:
        find_recorded(path, FRAMES)
    assert why in str(caught.value)


def test_references_in_a_circle_end() -> None:
    frames: list[dict[str, Any]] = [
        {"at": "a.py:1", "variables": {"a": "(the same as b)", "b": "(the same as a)"}}
    ]
    assert str(find_recorded("a", frames).value).startswith("(the same as")
