"""What a client gives a tool: refused where the tool cannot mean it, in words a model can act on.

The SDK ignores an argument that a tool does not have, so that the answer would be to another
question than was asked; and it tells what is wrong with a value in the words of its validator.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any, Final

from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from webots_mcp.naming import nearest_first

_MOST_FAULTS: Final = 3
_UNSAID: Final = ("title", "anyOf", "maxLength", "maxProperties")
_LONGEST_VALUE: Final = 80


class CheckedTool(Tool):
    """A tool of ours, which takes no arguments but its own."""

    def model_post_init(self, context: Any, /) -> None:
        """Say so in the schema as well, and leave out of it what says nothing."""
        slim = {name: _slim(schema) for name, schema in self.parameters["properties"].items()}
        self.parameters |= {"properties": slim, "additionalProperties": False}
        self.parameters.pop("title", None)

    async def run(
        self, arguments: dict[str, Any], context: Any, convert_result: bool = False
    ) -> Any:
        """Run the tool.

        Raises:
            ToolError: An argument is unknown, missing or out of bounds, or the tool refused.
        """
        properties = self.parameters["properties"]
        _require_known(arguments, properties)
        meant = {name: _as_meant(value, properties[name]) for name, value in arguments.items()}
        try:
            return await super().run(meant, context, convert_result)
        except ToolError as error:
            if isinstance(error.__cause__, ValidationError):
                raise ToolError(_explained(error.__cause__)) from error
            raise


def _slim(schema: dict[str, Any]) -> dict[str, Any]:
    """A parameter's schema without what says nothing.

    That is its name once more, null or an empty default for "may be left out", and the longest
    text, which only an absurd one exceeds.
    """
    choices: list[dict[str, Any]]
    choices = [choice for choice in schema.get("anyOf", ()) if choice != {"type": "null"}]
    whole = schema | (choices[0] if len(choices) == 1 else {})
    kept = {key: value for key, value in whole.items() if key not in _UNSAID}
    if kept.get("default", ...) in (None, ""):
        del kept["default"]
    return kept | ({"anyOf": choices} if len(choices) > 1 else {})


def _require_known(arguments: Iterable[str], known: Iterable[str]) -> None:
    for name in arguments:
        if name not in known:
            there = ", ".join(nearest_first(name, known)) or "none"
            raise ToolError(f"no parameter {_shown(name)}: there is {there}")


def _as_meant(value: Any, schema: dict[str, Any]) -> Any:
    """One item, where a list is asked for, is a list of one."""
    is_one = schema.get("type") == "array" and value is not None and not _is_list(value)
    return [value] if is_one else value


def _is_list(value: object) -> bool:
    """Whether it is a list, or the JSON text of one, which the SDK reads."""
    return isinstance(value, list) or (isinstance(value, str) and value.lstrip().startswith("["))


def _explained(error: ValidationError) -> str:
    faults = {str(each["loc"][0]): _fault(each) for each in reversed(error.errors())}
    return "; ".join(list(faults.values())[:_MOST_FAULTS])


def _fault(error: ErrorDetails) -> str:
    """One thing that is wrong: the parameter, what is asked of it, and what came."""
    parameter, *inside = error["loc"]  # a name after it is a type that the value might have had
    name = ".".join(map(str, (parameter, *(item for item in inside if isinstance(item, int)))))
    if error["type"] == "missing":
        return f"{name} is missing"
    asked = re.sub(r"^(Value error, |\w+ should )", "must ", error["msg"])
    if error["type"] == "int_parsing_size":
        asked = "must be a smaller number"
    return f"{name} {asked}, not {_shown(error['input'])}{_near(error)}"


def _near(error: ErrorDetails) -> str:
    """The choice that was perhaps meant."""
    choices = re.findall(r"'([^']+)'", error["msg"])
    near = difflib.get_close_matches(str(error["input"])[:_LONGEST_VALUE], choices, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""


def _shown(value: object) -> str:
    return repr(value)[:_LONGEST_VALUE]
