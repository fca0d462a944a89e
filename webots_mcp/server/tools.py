"""Questions as MCP tools: their descriptions, and their answers as results of calls.

`tool_arguments` checks what a client sends. Arguments whose type has pydantic's `SkipJsonSchema`
are those of earlier versions: they are accepted, and are in no schema.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable
from typing import Any, Final

from mcp import MCPError
from mcp.server.mcpserver import Context, Image
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import (
    CallToolResult,
    ContentBlock,
    InputRequiredResult,
    TextContent,
    ToolAnnotations,
)

from webots_mcp.answers.answer_models import ShownPicture
from webots_mcp.answers.shortening import cut_text
from webots_mcp.errors import WebotsMCPError
from webots_mcp.questions.declaration import Caller, Question, Reply
from webots_mcp.server.connected_clients import requester_of
from webots_mcp.server.consent import ask_with_consent
from webots_mcp.server.freed_memory import give_back
from webots_mcp.server.tool_arguments import CheckedTool
from webots_mcp.store.recording import RecordingAccess

_CONTEXT: Final = Context[Any]  # evaluated once: it takes as long as declaring an argument
_log = logging.getLogger(__name__)


def tool_of(question: Question, recording: RecordingAccess, *, output_schema: bool = False) -> Tool:
    """Return a question as a tool; its schemas, which take milliseconds, are made once.

    Args:
        question: The question.
        recording: What it is asked of.
        output_schema: Whether it has the schema of its answers.
    """
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
    ).model_copy(update={"of_controller": question.of_controller})


def _answering(question: Question) -> Callable[..., Any]:
    """Return the question as the SDK calls it; it answers whatever happens."""

    @functools.wraps(question.function)
    async def wrapper(recording: RecordingAccess, ctx: Context[Any], **arguments: Any) -> Any:
        companions = ctx.request_context.lifespan_context
        caller = Caller("mcp", ctx.report_progress, companions, requester_of(ctx))
        try:
            call = functools.partial(question.ask, recording, arguments, caller)
            reply = await ask_with_consent(ctx, recording, question.name, arguments, call)
            return reply if isinstance(reply, InputRequiredResult) else _as_result(reply)
        except WebotsMCPError as error:
            rows = f" (left out: {'; '.join(error.left_out)})" if error.left_out else ""
            # It may repeat what the model itself has sent.
            raise ToolError(f"{cut_text(str(error), 4_000)}{rows}") from error
        except (MCPError, ToolError):
            raise
        except Exception as error:
            _log.exception("%s failed", question.name)
            raise ToolError(
                "a defect of webots-mcp, or rows that it did not write "
                f"({type(error).__name__}: {str(error)[:200]}); ask for another range "
                "or by another tool, and report what the server wrote to stderr"
            ) from error
        finally:
            give_back()

    context = inspect.Parameter("ctx", inspect.Parameter.KEYWORD_ONLY, annotation=_CONTEXT)
    own = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in question.parameters]
    vars(wrapper)["__signature__"] = question.signature.replace(parameters=[*own, context])
    wrapper.__annotations__ = {"ctx": _CONTEXT}
    return wrapper


def _as_result(reply: Reply) -> CallToolResult:
    """Structured content and the same as compact text; pictures and their captions as they are."""
    content = [_block(each) for each in reply.shown]
    if reply.data is None:
        return CallToolResult(content=content)
    bad = reply.data.get("outcome") in ("failed", "expired", "cancelled", "lost")
    return CallToolResult(content=content, structured_content=reply.data, is_error=bad)


def _block(shown: str | ShownPicture) -> ContentBlock:
    if isinstance(shown, str):
        return TextContent(text=shown)
    return Image(data=shown.data, format=shown.format).to_image_content()
