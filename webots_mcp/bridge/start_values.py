"""First values of parameters from the environment, which replace those in the code."""

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
    """The value of `WEBOTS_MCP_PARAMETERS`: a JSON object of values by the names of parameters.

    In addition it may have objects by the names of robots, whose values are for that robot alone:
    `{"kp": 3.0, "rover": {"kp": 4.0}}`. A value that cannot be used is warned of, and the code's
    value is used.

    Args:
        text: The variable's value; None or empty where it is not set.
        robot: The name of this robot.
        errors: Receives a warning for each value that cannot be used.
    """

    def __init__(self, text: str | None, robot: str, errors: ErrorReport) -> None:
        self._text = text
        self._robot = robot
        self._errors = errors
        self._values: dict[str, Any] | None = None
        self._unknown_reported = not text

    def take(self, declaration: Declaration) -> Value | None:
        """The first value of a parameter; None for the one in the code."""
        values = self._read()
        if declaration.name not in values:
            return None
        try:
            return declaration.checked(values[declaration.name])
        except InvalidInputError as error:
            self._warn(declaration.name, f"{error}; it begins with {declaration.default!r}")
            return None

    def warn_of_unknown(self, declared: Container[str]) -> None:
        """Warn once of names that the controller has not declared before its first command call."""
        if self._unknown_reported:
            return
        self._unknown_reported = True
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
            example = 'not an object such as {"kp": 3.0}'
            self._warn("", f"{why}, {example}; the code's values are used")
            return {}
        values = cast("dict[str, Any]", found)
        own = values.get(self._robot)
        return {**values, **cast("dict[str, Any]", own)} if isinstance(own, dict) else values

    def _warn(self, kind: str, why: str) -> None:
        self._errors.warn(f"{PARAMETERS_VARIABLE} {kind}", f"{PARAMETERS_VARIABLE}: {why}")
