"""A rule that forbids an action holds for the actions that have its effect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from webots_mcp.errors import NotAllowedError
from webots_mcp.store.policy import read_policy


@pytest.mark.parametrize(
    ("forbidden", "action", "params"),
    [
        ("pause", "step", {}),
        ("pause", "run", {"then": "pause"}),
        ("fast", "run", {"pace": "fast", "then": "go_on"}),
        ("resume", "run", {"then": "go_on"}),
        ("set_parameters", "run", {"parameters": {"speed": 1.0}, "then": "go_on"}),
    ],
)
def test_what_has_the_effect_of_a_forbidden_action_is_refused_with_its_line(
    tmp_path: Path, forbidden: str, action: str, params: dict[str, Any]
) -> None:
    file = tmp_path / "webots-mcp.toml"
    file.write_text(f'[ allow ]\nactions = ["{action}", "!{forbidden}"]\n')
    policy = read_policy(file)
    assert policy is not None
    with pytest.raises(NotAllowedError, match=f"'{forbidden}'.*line 2: actions"):
        policy.require(action, params)
    file.write_text(f'[allow]\nactions = ["{action}"]\n')
    free = read_policy(file)
    assert free is not None
    free.require(action, params)
