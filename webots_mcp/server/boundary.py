"""Where our functions become MCP tools: their declaration, their errors and their answers.

Every tool passes `tool`, so that this is the one place where our exceptions become `ToolError`
and where an answer gets its text.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, ParamSpec, TypeVar, cast, get_type_hints

from mcp import MCPError
from mcp.server.mcpserver import Context
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import CallToolResult, TextContent, ToolAnnotations

from webots_mcp.errors import (
    MalformedRowError,
    NoDatabaseError,
    NothingRecordedError,
    WebotsMCPError,
)
from webots_mcp.server.arguments import CheckedTool
from webots_mcp.server.results import Answer, CommandAnswer
from webots_mcp.server.shortening import compact_json, cut_text
from webots_mcp.store.sound import Unsound, past_unsound_rows

READS: Final = ToolAnnotations(read_only_hint=True, open_world_hint=False)
ACTS: Final = ToolAnnotations(
    read_only_hint=False, destructive_hint=False, idempotent_hint=False, open_world_hint=False
)
RESTARTS: Final = ACTS.model_copy(update={"destructive_hint": True})

_BAD_ENDS: Final = ("failed", "expired", "cancelled", "lost")
_LONGEST_DEFECT: Final = 200
_LONGEST_ERROR: Final = 4_000  # characters: it may repeat what the model itself has sent
_DECLARATION: Final = "webots_mcp_declaration"

_log = logging.getLogger(__name__)

_P = ParamSpec("_P")
_R = TypeVar("_R")


@dataclass(frozen=True)
class Declaration:
    """What a client is told about a tool beside its name and its parameters."""

    title: str
    annotations: ToolAnnotations


def tool(
    title: str, annotations: ToolAnnotations
) -> Callable[[Callable[_P, _R]], Callable[_P, _R]]:
    """Declare a method as an MCP tool of its own name.

    Its docstring is the description. An `Answer` goes out as structured content and as the same
    compact text; our errors become `ToolError`; where nothing was recorded, a reading tool
    answers so instead of failing.
    """

    def declare(method: Callable[_P, _R]) -> Callable[_P, _R]:
        wrap = _wrap_async if inspect.iscoroutinefunction(method) else _wrap
        wrapper = wrap(method, _empty_answer(method, annotations))
        setattr(wrapper, _DECLARATION, Declaration(title, annotations))
        return cast("Callable[_P, _R]", wrapper)

    return declare


def tools_of(family: object, *, read_only: bool) -> Iterator[Tool]:
    """The declared tools of an object; with `read_only` those that only read."""
    for method, declaration in _declared(family):
        if declaration.annotations.read_only_hint or not read_only:
            yield CheckedTool.from_function(
                method,
                title=declaration.title,
                description=inspect.getdoc(method),
                annotations=declaration.annotations,
            )


def reporter(ctx: Context[Any]) -> Callable[[float, float, str], Awaitable[None]]:
    """Progress for the client that asked, if it wants any: done, total, message."""

    async def report(done: float, total: float, message: str) -> None:
        await ctx.report_progress(done, total, message)

    return report


def _declared(family: object) -> Iterator[tuple[Callable[..., Any], Declaration]]:
    for name in vars(type(family)):
        declaration = getattr(getattr(family, name), _DECLARATION, None)
        if isinstance(declaration, Declaration):
            yield getattr(family, name), declaration


def _wrap(method: Callable[..., Any], empty: Callable[[str], Any] | None) -> Callable[..., Any]:
    @functools.wraps(method)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        unsound: Unsound | None = None
        try:
            if empty is not None:
                try:
                    return _as_result(method(*args, **kwargs))
                except Exception as error:  # noqa: BLE001  (the next line tells which)
                    _require_over_a_value(error)
            with past_unsound_rows() as unsound:
                return _as_result(method(*args, **kwargs), unsound)
        except Exception as error:  # noqa: BLE001  (each becomes an answer)
            return _as_result(_answer_error(method.__name__, error, empty, unsound), unsound)

    return wrapper


def _wrap_async(
    method: Callable[..., Any], empty: Callable[[str], Any] | None
) -> Callable[..., Any]:
    @functools.wraps(method)
    async def wrapper(*args: Any, **kwargs: Any) -> Any:
        unsound: Unsound | None = None
        try:
            if empty is not None:
                try:
                    return _as_result(await method(*args, **kwargs))
                except Exception as error:  # noqa: BLE001  (the next line tells which)
                    _require_over_a_value(error)
            with past_unsound_rows() as unsound:
                return _as_result(await method(*args, **kwargs), unsound)
        except Exception as error:  # noqa: BLE001  (each becomes an answer)
            return _as_result(_answer_error(method.__name__, error, empty, unsound), unsound)

    return wrapper


def _require_over_a_value(error: Exception) -> None:
    """Raise the error again unless it may be owed to a value that no bridge has written."""
    ours = isinstance(error, (WebotsMCPError, MCPError, ToolError))
    if ours and not isinstance(error, MalformedRowError):
        raise error


def _answer_error(
    tool: str, error: Exception, empty: Callable[[str], Any] | None, unsound: Unsound | None
) -> Any:
    """Our errors tell the model what to do; of a defect the server's log has the rest.

    What is missing may be so for rows that were left out: they are named beside each of our errors.
    """
    if empty is not None and isinstance(error, (NoDatabaseError, NothingRecordedError)):
        return empty(str(error))
    if isinstance(error, WebotsMCPError):
        left_out = unsound.described() if unsound else []
        rows = f" (left out: {'; '.join(left_out)})" if left_out else ""
        raise ToolError(f"{cut_text(str(error), _LONGEST_ERROR)}{rows}") from error
    if isinstance(error, (MCPError, ToolError)):
        raise error
    _log.exception("%s failed", tool)
    raise ToolError(
        f"a defect of webots-mcp, or rows that it did not write ({type(error).__name__}: "
        f"{str(error)[:_LONGEST_DEFECT]}); ask for another range or by another tool, and report "
        "what the server wrote to stderr"
    ) from error


def _empty_answer(
    method: Callable[..., Any], annotations: ToolAnnotations
) -> Callable[[str], Any] | None:
    """How a reading tool answers that nothing was recorded; None for one that acts.

    A reading tool can be asked twice; one that acts looks past unsound rows at once.
    """
    if not annotations.read_only_hint:
        return None
    answer = get_type_hints(method)["return"]
    if isinstance(answer, type) and issubclass(answer, Answer):
        return lambda text: answer(status="never seen", hint=text)
    return lambda text: [text]


def _as_result(answer: Any, unsound: Unsound | None = None) -> Any:
    """Structured content and the same as compact text; pictures and their captions as they are."""
    left_out = unsound.described() if unsound else []
    if not isinstance(answer, Answer):
        return [*answer, compact_json({"left_out": left_out})] if left_out else answer
    answer.left_out = left_out or None
    data = answer.model_dump(mode="json", exclude_none=True)
    text = compact_json(data)
    text.encode()  # what UTF-8 cannot hold would end the connection to the client
    bad = isinstance(answer, CommandAnswer) and answer.outcome in _BAD_ENDS
    return CallToolResult(content=[TextContent(text=text)], structured_content=data, is_error=bad)
