"""Where questions become MCP tools: their schemas, what a client gives them, what it gets.

What a tool cannot mean is refused in words that a model can act on.

The SDK ignores an argument that a tool does not have, so that the answer would be to another
question than was asked; and it tells what is wrong with a value in the words of its validator.

What another server with tools of these names takes is taken as well: all arguments in one object
`params`, and a `response_format`, whatever it says. Parameters whose type has pydantic's
`SkipJsonSchema` are for its habits too: they are taken, and stand in no schema.
"""

from __future__ import annotations

import functools
import inspect
import json
import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Final, cast

from mcp import MCPError
from mcp.server import MCPServer
from mcp.server.mcpserver import Context, Image
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import (
    INVALID_PARAMS,
    CallToolResult,
    ContentBlock,
    GetPromptResult,
    InputRequiredResult,
    TextContent,
    ToolAnnotations,
)
from pydantic import ValidationError

from webots_mcp.errors import WebotsMCPError
from webots_mcp.naming import nearest_first
from webots_mcp.questions.answers import ShownPicture
from webots_mcp.questions.declaring import Caller, Question, Reply
from webots_mcp.questions.faults import faults_of, shown_value
from webots_mcp.questions.shortening import cut_text
from webots_mcp.store.recording import Recording

_WRAPPER: Final = "params"
_FORMAT: Final = "response_format"
_FORMATS: Final = (None, "json", "markdown")
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
_NOBODY_ASKS_FOR: Final = 1_000
_BAD_ENDS: Final = ("failed", "expired", "cancelled", "lost")
_LONGEST_DEFECT: Final = 200
_LONGEST_ERROR: Final = 4_000  # characters: it may repeat what the model itself has sent

_log = logging.getLogger(__name__)


def tool_of(question: Question, recording: Recording, *, output_schema: bool = False) -> Tool:
    """A question on a recording as a tool; its schemas, which take milliseconds, are made once."""
    tool = _tool(question, output_schema)
    return tool.model_copy(update={"fn": functools.partial(tool.fn, recording)})


@functools.cache
def _tool(question: Question, output_schema: bool) -> Tool:
    effect = question.effect
    return CheckedTool.from_function(
        _answering(question),
        title=question.title,
        description=inspect.getdoc(question.function),
        annotations=ToolAnnotations(
            read_only_hint=effect.reads,
            destructive_hint=None if effect.reads else effect.destroys,
            idempotent_hint=None if effect.reads else effect.repeats or None,
            open_world_hint=False,
        ),
        structured_output=None if output_schema else False,
    )


def _answering(question: Question) -> Callable[..., Any]:
    """The question as the SDK calls it, after a recording; with an answer whatever happens."""

    @functools.wraps(question.function)
    async def wrapper(recording: Recording, ctx: Context[Any], **arguments: Any) -> Any:
        companions = ctx.request_context.lifespan_context
        caller = Caller("mcp", ctx.report_progress, companions)
        try:
            return _as_result(await question.ask(recording, arguments, caller))
        except WebotsMCPError as error:
            rows = f" (left out: {'; '.join(error.left_out)})" if error.left_out else ""
            raise ToolError(f"{cut_text(str(error), _LONGEST_ERROR)}{rows}") from error
        except (MCPError, ToolError):
            raise
        except Exception as error:
            _log.exception("%s failed", question.name)
            raise ToolError(
                "a defect of webots-mcp, or rows that it did not write "
                f"({type(error).__name__}: {str(error)[:_LONGEST_DEFECT]}); ask for another range "
                "or by another tool, and report what the server wrote to stderr"
            ) from error

    context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=Context[Any])
    own = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in question.parameters]
    vars(wrapper)["__signature__"] = question.signature.replace(parameters=[*own, context])
    wrapper.__annotations__ = {"ctx": Context[Any]}
    return wrapper


def _as_result(reply: Reply) -> CallToolResult:
    """Structured content and the same as compact text; pictures and their captions as they are."""
    content = [_block(each) for each in reply.shown]
    if reply.data is None:
        return CallToolResult(content=content)
    bad = reply.data.get("outcome") in _BAD_ENDS
    return CallToolResult(content=content, structured_content=reply.data, is_error=bad)


def _block(shown: str | ShownPicture) -> ContentBlock:
    if isinstance(shown, str):
        return TextContent(text=shown)
    return Image(data=shown.data, format=shown.format).to_image_content()


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
                raise ToolError(faults_of(error.__cause__)) from error
            raise


class ToolServer(MCPServer):
    """A server that answers to more names than it lists: those of questions that were merged."""

    def __init__(
        self,
        *arguments: Any,
        unlisted: Mapping[str, Callable[[], Tool]],
        withheld: Collection[str],
        **options: Any,
    ) -> None:
        super().__init__(*arguments, **options)
        self._unlisted = unlisted
        self._withheld = withheld

    async def call_tool(
        self, name: str, arguments: dict[str, Any], context: Context[Any, Any] | None = None
    ) -> CallToolResult | InputRequiredResult:
        """Call a tool, also one that is not listed.

        Raises:
            ToolError: There is no such tool, or it refused.
        """
        if name in self._withheld:
            raise ToolError(
                f"{name} changes the simulation or the recording, and this server is --read-only: "
                "ask for a server that was started without"
            )
        if self._tool_manager.get_tool(name) is None and (make := self._unlisted.get(name)):
            context = context or Context(mcp_server=self)
            return await make().run(arguments, context, convert_result=True)
        return await super().call_tool(name, arguments, context)

    async def get_prompt(
        self,
        name: str,
        arguments: dict[str, Any] | None = None,
        context: Context[Any, Any] | None = None,
    ) -> GetPromptResult | InputRequiredResult:
        """A prompt; clients give an optional argument that nobody filled in as an empty text.

        Raises:
            MCPError: There is no such prompt, or an argument is missing or invalid.
        """
        filled_in = {name: value for name, value in (arguments or {}).items() if value != ""}
        try:
            return await super().get_prompt(name, filled_in, context)
        except ValueError as error:  # the SDK by itself answers "Internal server error"
            cause = error.__cause__ and error.__cause__.__cause__
            said = faults_of(cause) if isinstance(cause, ValidationError) else str(error)
            raise MCPError(INVALID_PARAMS, said) from error


def _slim(schema: dict[str, Any]) -> dict[str, Any]:
    """A parameter's schema without what says nothing.

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
    """Whether it is a bound beyond what anybody asks for."""
    return key == "maximum" and value >= _NOBODY_ASKS_FOR


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
        raise ToolError(f"{_FORMAT} must be 'json' or 'markdown', not {shown_value(asked)}")
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
            raise ToolError(f"no parameter {shown_value(name)}: there is {there}")


def _as_meant(value: Any, schema: dict[str, Any]) -> Any:
    """One item, where a list is asked for, is a list of one."""
    is_one = schema.get("type") == "array" and value is not None and not _is_list(value)
    return [value] if is_one else value


def _is_list(value: object) -> bool:
    """Whether it is a list, or the JSON text of one, which the SDK reads."""
    return isinstance(value, list) or (isinstance(value, str) and value.lstrip().startswith("["))
