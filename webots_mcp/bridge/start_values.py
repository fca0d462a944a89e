"""Values that parameters get from the environment, in place of those in the code."""

from __future__ import annotations

import json
from collections.abc import Container
from typing import Any, Final, cast

from webots_mcp.bridge.error_report import ErrorReport
from webots_mcp.contract import PARAMETERS_VARIABLE
from webots_mcp.errors import InvalidInputError
from webots_mcp.parameter import Declaration, Value

_MOST_NAMED: Final = 5


class StartValues:
    """What `WEBOTS_MCP_PARAMETERS` says: a JSON object of values by the names of parameters.

    Beside them it may have objects by the names of robots, whose values are for that robot alone:
    `{"kp": 3.0, "rover": {"kp": 4.0}}`. What cannot be used is warned of, and the code's value
    counts.

    Args:
        text: The variable's value; None or empty without any.
        robot: The name of this robot.
        errors: Is told of what cannot be used.
    """

    def __init__(self, text: str | None, robot: str, errors: ErrorReport) -> None:
        self._text = text
        self._robot = robot
        self._errors = errors
        self._values: dict[str, Any] | None = None
        self._unknown_told = not text

    def take(self, declaration: Declaration) -> Value | None:
        """The value that a parameter begins with; None for the one in the code."""
        values = self._read()
        if declaration.name not in values:
            return None
        try:
            return declaration.checked(values[declaration.name])
        except InvalidInputError as error:
            self._warn(declaration.name, f"{error}; it begins with {declaration.default!r}")
            return None

    def warn_of_unknown(self, declared: Container[str]) -> None:
        """Warn once of names that the controller has not declared before it asked for commands."""
        if self._unknown_told:
            return
        self._unknown_told = True
        unknown = [  # an object by another name may be for another robot
            name
            for name, value in self._read().items()
            if name not in declared and not isinstance(value, dict)
        ]
        if unknown:
            named = ", ".join(f"{name!r:.80}" for name in unknown[:_MOST_NAMED])
            self._warn("unknown", f"the controller declares no parameter {named}")

    def _read(self) -> dict[str, Any]:
        if self._values is None:
            self._values = self._parsed() if self._text else {}
        return self._values

    def _parsed(self) -> dict[str, Any]:
        try:
            found = json.loads(self._text or "")
        except (ValueError, RecursionError) as error:
            found, why = None, f"it is not JSON ({error})"
        else:
            why = f"it is a {type(found).__name__}"
        if not isinstance(found, dict):
            self._warn("", f'{why}, not an object such as {{"kp": 3.0}}; the code\'s values count')
            return {}
        values = cast("dict[str, Any]", found)
        own = values.get(self._robot)
        return {**values, **cast("dict[str, Any]", own)} if isinstance(own, dict) else values

    def _warn(self, kind: str, why: str) -> None:
        self._errors.warn(f"{PARAMETERS_VARIABLE} {kind}", f"{PARAMETERS_VARIABLE}: {why}")
