"""Where functions become MCP tools: their declaration, their errors and their answers.

Every tool passes `tool`, so that this is the one place where our exceptions become `ToolError`
and where an answer gets its text.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Final, get_type_hints

from anyio import to_thread
from mcp import MCPError
from mcp.server.mcpserver.exceptions import ToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import CallToolResult, ContentBlock, TextContent, ToolAnnotations

from webots_mcp.errors import (
    MalformedRowError,
    NoDatabaseError,
    NothingRecordedError,
    WebotsMCPError,
)
from webots_mcp.server.arguments import CheckedTool
from webots_mcp.server.parameters import SCOPE
from webots_mcp.server.results import Answer, CommandAnswer
from webots_mcp.server.shortening import compact_json, cut_text
from webots_mcp.store.reading.ranges import Scope
from webots_mcp.store.recording import Recording
from webots_mcp.store.sound import Unsound, past_unsound_rows

READS: Final = ToolAnnotations(read_only_hint=True, open_world_hint=False)
ACTS: Final = ToolAnnotations(
    read_only_hint=False, destructive_hint=False, idempotent_hint=False, open_world_hint=False
)
RESTARTS: Final = ACTS.model_copy(update={"destructive_hint": True})

_BAD_ENDS: Final = ("failed", "expired", "cancelled", "lost")
_LONGEST_DEFECT: Final = 200
_LONGEST_ERROR: Final = 4_000  # characters: it may repeat what the model itself has sent
_SCOPE_PARAMETERS: Final = [
    inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
    for name, annotation in SCOPE.items()
]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Declaration:
    """A function that is a tool, and what a client learns of it beside name and parameters.

    Attributes:
        function: Its first parameter is the recording, the others are the client's; in place of
            one called `scope`, a client gives what `SCOPE` lists.
    """

    function: Callable[..., Any]
    title: str
    annotations: ToolAnnotations

    @property
    def only_reads(self) -> bool:
        """Whether it changes nothing, neither the simulation nor the recording."""
        return self.annotations.read_only_hint is True

    def registered(self, recording: Recording) -> Tool:
        """The tool on a recording."""
        on_recording = functools.partial(self._tool.fn, recording)
        return self._tool.model_copy(update={"fn": on_recording})

    @functools.cached_property
    def _tool(self) -> Tool:
        """On no recording yet. Its schemas, which take the SDK milliseconds, serve all servers."""
        return CheckedTool.from_function(
            _answering(self.function, only_reads=self.only_reads),
            title=self.title,
            description=inspect.getdoc(self.function),
            annotations=self.annotations,
        )


def tool(title: str, annotations: ToolAnnotations) -> Callable[[Callable[..., Any]], Declaration]:
    """Declare a function as an MCP tool of its own name.

    Its docstring is the description. An `Answer` goes out as structured content and as the same
    compact text; our errors become `ToolError`; where nothing was recorded, a reading tool
    answers so instead of failing.
    """
    return lambda function: Declaration(function, title, annotations)


def tools_of(module: ModuleType, recording: Recording, *, read_only: bool) -> Iterator[Tool]:
    """The tools that a module declares; with `read_only` those that only read."""
    for declared in tuple(vars(module).values()):
        if isinstance(declared, Declaration) and (declared.only_reads or not read_only):
            yield declared.registered(recording)


def _answering(function: Callable[..., Any], *, only_reads: bool) -> Callable[..., Any]:
    """The function as the SDK calls it, after a recording; with an answer whatever happens."""
    empty = _empty_answer(function) if only_reads else None
    is_async = inspect.iscoroutinefunction(function)

    signature = inspect.signature(function, eval_str=True)
    _, *parameters = signature.parameters.values()
    gathers = any(each.annotation is Scope for each in parameters)

    async def call(recording: Recording, arguments: dict[str, Any]) -> Any:
        if gathers:
            scope = Scope(**{name: arguments[name] for name in SCOPE})
            rest = {name: value for name, value in arguments.items() if name not in SCOPE}
            arguments = rest | {"scope": scope}
        if is_async:
            return await function(recording, **arguments)
        return await to_thread.run_sync(lambda: function(recording, **arguments))

    @functools.wraps(function)
    async def wrapper(recording: Recording, **arguments: Any) -> Any:
        unsound: Unsound | None = None
        try:
            if empty is not None:
                try:
                    return _as_result(await call(recording, arguments))
                except Exception as error:  # noqa: BLE001  (the next line tells which)
                    _require_over_a_value(error)
            with past_unsound_rows() as unsound:
                return _as_result(await call(recording, arguments), unsound)
        except Exception as error:  # noqa: BLE001  (each becomes an answer)
            return _as_result(_answer_error(function.__name__, error, empty, unsound), unsound)

    flat = [each for each in parameters if each.annotation is not Scope]
    flat += _SCOPE_PARAMETERS if gathers else []
    vars(wrapper)["__signature__"] = signature.replace(parameters=flat)
    return wrapper


def _require_over_a_value(error: Exception) -> None:
    """Raise the error again unless it may be owed to a value that no bridge has written."""
    ours = isinstance(error, (WebotsMCPError, MCPError, ToolError))
    if ours and not isinstance(error, MalformedRowError):
        raise error


def _answer_error(
    tool: str, error: Exception, empty: Callable[[str], Any] | None, unsound: Unsound | None
) -> Any:
    """Our errors tell the model what to do; the server's log has the rest of a defect.

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


def _empty_answer(function: Callable[..., Any]) -> Callable[[str], Any]:
    """How a reading tool answers that nothing was recorded.

    Only a reading tool can be asked twice; one that acts looks past unsound rows at once.
    """
    answer = get_type_hints(function)["return"]
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
    content: list[ContentBlock] = [TextContent(text=text), *answer.pictures]
    return CallToolResult(content=content, structured_content=data, is_error=bad)
