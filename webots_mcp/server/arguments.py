"""What a client gives a tool: refused where the tool cannot mean it, in words a model can act on.

The SDK ignores an argument that a tool does not have, so that the answer would be to another
question than was asked; and it tells what is wrong with a value in the words of its validator.

What another server with tools of these names takes is taken as well: all arguments in one object
`params`, and a `response_format`, whatever it says. Parameters whose type has pydantic's
`SkipJsonSchema` are for its habits too: they are taken, and stand in no schema.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Collection, Iterable
from typing import Any, Final, cast

from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from webots_mcp.naming import nearest_first, same_in_meaning

_WRAPPER: Final = "params"
_FORMAT: Final = "response_format"
_FORMATS: Final = (None, "json", "markdown")
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
        required = self.parameters.get("required", ())
        arguments = _unwrapped(arguments, properties, required)
        _require_known(arguments, self.fn_metadata.arg_model.model_fields, properties)
        meant = {
            name: _as_meant(value, properties.get(name, {}))
            for name, value in arguments.items()
            if value is not None or name in required  # null is as good as left out
        }
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


def _unwrapped(
    arguments: dict[str, Any], own: Collection[str], required: Iterable[str]
) -> dict[str, Any]:
    """The arguments of a client, without what was written for another server."""
    is_needed = any(name not in arguments for name in required)
    if arguments.keys() == {_WRAPPER} and (_WRAPPER not in own or is_needed):
        inner = _as_object(arguments[_WRAPPER])
        arguments = arguments if inner is None else inner
    asked = arguments.get(_FORMAT)
    if asked not in _FORMATS:
        raise ToolError(f"{_FORMAT} must be 'json' or 'markdown', not {_shown(asked)}")
    return {name: value for name, value in arguments.items() if name != _FORMAT}


def _as_object(value: Any) -> dict[str, Any] | None:
    """An object, or the JSON text of one."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError):
            return None
    return cast("dict[str, Any]", value) if isinstance(value, dict) else None


def _require_known(arguments: Iterable[str], known: Collection[str], listed: Iterable[str]) -> None:
    for name in arguments:
        if name not in known:
            there = ", ".join(nearest_first(name, listed)) or "none"
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
    """What was perhaps meant."""
    choices = re.findall(r"'([^']+)'", error["msg"])
    given = str(error["input"])[:_LONGEST_VALUE]
    near = same_in_meaning(given, choices) or difflib.get_close_matches(given, choices, n=1)
    return f"; did you mean {' or '.join(map(repr, near))}?" if near else ""


def _shown(value: object) -> str:
    return repr(value)[:_LONGEST_VALUE]
