"""The arguments of a tool as a client sends them: checked, unwrapped, and refused in clear words.

The SDK ignores an argument that a tool does not have, and reports an invalid value in the words of
its validator. Here both are refused in words on which a model can act. The calls of the first
server are accepted too: all arguments in one object `params`, and a `response_format`, which
changes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping
from typing import Any, Final, cast

from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from pydantic import ValidationError

from webots_mcp.answers.shortening import compact_json
from webots_mcp.questions.argument_errors import faults_of, shown_value
from webots_mcp.signals.naming import harmless_first, perhaps_meant

_WRAPPER: Final = "params"
_FORMAT: Final = "response_format"
_UNSAID: Final = (
    "title", "anyOf", "maxLength", "minLength", "maxProperties", "minProperties", "maxItems",
)  # fmt: skip
_USUAL: Final[Mapping[str, tuple[Any, ...]]] = {  # what a model takes for granted
    "default": (None, "", False),  # and 0
    "minimum": (0, 1),
    "exclusiveMinimum": (0,),
    "minItems": (1,),
    "additionalProperties": (True, {}),
}


class CheckedTool(Tool):
    """A tool of ours, which takes no arguments but its own.

    Attributes:
        of_controller: The argument that takes names which the controller has declared.
    """

    of_controller: str | None = None

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
        if unknown := arguments.keys() - self.fn_metadata.arg_model.model_fields.keys():
            raise ToolError(self._unknown(arguments, unknown))
        meant = {
            name: _as_meant(value, properties.get(name, {}))
            for name, value in arguments.items()
            if value is not None or name in required  # null is as good as left out
        }
        try:
            return await super().run(meant, context, convert_result)
        except ToolError as error:
            if isinstance(error.__cause__, ValidationError):
                raise ToolError(self._invalid(error.__cause__)) from error
            raise

    def _invalid(self, error: ValidationError) -> str:
        """Return what is wrong with the arguments, and what the first of them means."""
        faults = faults_of(error)
        name = str(error.errors()[0]["loc"][0])
        end = "" if faults.endswith("?") else "."
        return f"{faults}{end}{self._meaning(name)}"

    def _meaning(self, name: str) -> str:
        text = self.parameters["properties"].get(name, {}).get("description", "")
        return f" {name}: {text}" if text else ""

    def _unknown(self, arguments: dict[str, Any], unknown: Collection[str]) -> str:
        """Return which argument the tool does not have, and what was perhaps meant."""
        names = [name for name in arguments if name in unknown]
        listed, inside = list(self.parameters["properties"]), self.of_controller
        typo = next((name for name in names if perhaps_meant(name, listed)), None)
        said = f"Unknown argument {shown_value(typo or names[0])}."
        if inside and inside not in arguments and typo is None:
            own = {name: value for name, value in arguments.items() if name not in unknown}
            call = self._call(own, inside, _unboxed({name: arguments[name] for name in names}))
            return f"{said} Names of the controller go into `{inside}`: {call}"
        near = harmless_first(typo or names[0], listed)
        if not near:
            return f"{said} {self.name} takes no arguments."
        meaning = self._meaning(near[0]) if typo or len(near) == 1 else ""
        return f"{said} {self.name} takes {', '.join(near)}.{meaning}"

    def _call(self, own: Mapping[str, Any], inside: str, values: Mapping[str, Any]) -> str:
        """Return a call with all required arguments; values that make it too long become dots."""
        required = self.parameters.get("required", ())
        lacking = {each: "..." for each in required if each != inside and each not in own}
        given = {name: compact_json(value) for name, value in own.items()}
        whole = lacking | given | {inside: compact_json(values)}
        if sum(map(len, whole.values())) > 300:
            short = {n: value if len(value) <= 60 else "..." for n, value in given.items()}
            whole = lacking | short | {inside: "{...}"}
        return f"{self.name}({', '.join(f'{name}={value}' for name, value in whole.items())})"


def _unboxed(values: dict[str, Any]) -> dict[str, Any]:
    """Names of the controller with their values, also where another tool's argument held them."""
    (name, value), *others = values.items()
    is_box = (
        not others
        and name in ("params", "parameters", "values", "arguments", "args")
        and isinstance(value, dict)
    )
    return cast("dict[str, Any]", value) if is_box else values


def _slim(schema: dict[str, Any]) -> dict[str, Any]:
    """Return a parameter's schema without what says nothing.

    That is its name once more, null or an empty default for "may be left out", and bounds that only
    an absurd value exceeds.
    """
    choices: list[dict[str, Any]]
    choices = [choice for choice in schema.get("anyOf", ()) if choice != {"type": "null"}]
    whole = schema | (choices[0] if len(choices) == 1 else {})
    kept = {
        key: value
        for key, value in whole.items()
        if key not in _UNSAID and value not in _USUAL.get(key, ()) and not _is_absurd(key, value)
    }
    if "items" in kept:
        kept["items"] = _slim(kept["items"])
    return kept | ({"anyOf": choices} if len(choices) > 1 else {})


def _is_absurd(key: str, value: Any) -> bool:
    """Return whether it is a bound beyond what anybody asks for."""
    return key == "maximum" and value >= 1_000


def _unwrapped(
    arguments: dict[str, Any], own: Collection[str], required: Iterable[str]
) -> dict[str, Any]:
    """Return the arguments without the wrapper and the format of the first server's calls.

    Raises:
        ToolError: It is no format of that server.
    """
    outer = _without_format(arguments)
    is_needed = any(name not in outer for name in required)
    if outer.keys() != {_WRAPPER} or (_WRAPPER in own and not is_needed):
        return outer
    inner = _as_object(outer[_WRAPPER])
    return outer if inner is None else _without_format(inner)


def _without_format(arguments: dict[str, Any]) -> dict[str, Any]:
    asked = arguments.get(_FORMAT)
    if asked not in (None, "json", "markdown"):
        raise ToolError(f"{_FORMAT} must be 'json' or 'markdown', not {shown_value(asked)}")
    return {name: value for name, value in arguments.items() if name != _FORMAT}


def _as_object(value: Any) -> dict[str, Any] | None:
    """Return an object, or the JSON text of one."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except (ValueError, RecursionError):
            return None
    return cast("dict[str, Any]", value) if isinstance(value, dict) else None


def _as_meant(value: Any, schema: dict[str, Any]) -> Any:
    """One item, where a list is asked for, is a list of one."""
    is_one = schema.get("type") == "array" and value is not None and not _is_list(value)
    return [value] if is_one else value


def _is_list(value: object) -> bool:
    """Return whether it is a list, or the JSON text of one, which the SDK reads."""
    return isinstance(value, list) or (isinstance(value, str) and value.lstrip().startswith("["))
