"""Asking the person before a request goes on, where a rule of the project's file says so.

A client that announces elicitation shows the question as a form to accept or decline. Clients of
protocols before 2026-07-28 are asked while the call goes on; later ones get the question as an
interim result and make the call again with the answer. Without elicitation the request is refused.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

import anyio
from mcp import MCPError
from mcp.server.mcpserver import Context
from mcp.types import (
    ElicitRequest,
    ElicitRequestFormParams,
    ElicitResult,
    InputRequiredResult,
)
from mcp_types.version import MODERN_PROTOCOL_VERSIONS
from pydantic import BaseModel

from webots_mcp.errors import ConsentRequiredError, NotAllowedError
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import Consent, note_answer, recorded_arguments

if TYPE_CHECKING:
    from webots_mcp.questions.declaration import Reply

ASK_TIMEOUT_S: Final = 90.0  # clients put a call aside, or give it up, after two minutes
MOST_QUESTIONS: Final = 5  # of one call: each is of another rule
_QUESTION: Final = "consent"
_FORM: Final[dict[str, Any]] = {"type": "object", "properties": {}}


class _AskedFor(BaseModel):
    """What a client brings back with an answer, sealed by the SDK for the same call alone.

    Attributes:
        agreed: The rules to which the person agreed before.
        rule: That of the question.
        text: The refusal if the person does not agree.
        request_id: The row in which the answer is recorded.
    """

    agreed: list[str]
    rule: str
    text: str
    request_id: int | None


async def ask_with_consent(
    ctx: Context[Any],
    recording: RecordingAccess,
    tool: str,
    arguments: Mapping[str, Any],
    call: Callable[[], Awaitable[Reply]],
) -> Reply | InputRequiredResult:
    """Answer a call; ask the person as often as rules want it, and then call again.

    Args:
        ctx: Of the call.
        recording: What it is about.
        tool: The name of the tool.
        arguments: Its arguments, as the person is shown them.
        call: Answers the call; does nothing before it raises that consent is required.

    Raises:
        NotAllowedError: A rule forbids it, or the person declined or did not answer.
    """
    if not _can_ask(ctx):
        return await call()
    agreed = await _agreed_before(ctx, recording)
    while len(agreed) < MOST_QUESTIONS:
        consent = Consent(agreed)
        try:
            with consent.given():
                return await call()
        except ConsentRequiredError as error:
            needed = error
        message = _message(ctx, tool, arguments, needed)
        if ctx.request_context.protocol_version in MODERN_PROTOCOL_VERSIONS:
            return _interim(message, agreed, needed)
        await _settle(recording, needed, await _answer(ctx, message))
        agreed.append(needed.rule)
    with Consent(agreed, can_ask=False).given():
        return await call()


def _can_ask(ctx: Context[Any]) -> bool:
    """Return whether the client shows forms; `elicitation: {}` says so as well."""
    capabilities = ctx.request_context.session.client_capabilities
    elicitation = capabilities.elicitation if capabilities else None
    return elicitation is not None and (elicitation.form is not None or elicitation.url is None)


def _message(
    ctx: Context[Any], tool: str, arguments: Mapping[str, Any], needed: ConsentRequiredError
) -> str:
    client = ctx.request_context.session.client_params
    name = client.client_info.name if client else "The client"
    return (
        f"{name} asks for {tool} with {recorded_arguments(arguments)}. "
        f"The file of the project wants you to be asked: {needed.rule}. "
        "Accept to let this one request go on; decline to refuse it."
    )


async def _answer(ctx: Context[Any], message: str) -> ElicitResult | str:
    """Return what the person answered, or why there is no answer."""
    with anyio.move_on_after(ASK_TIMEOUT_S):
        try:
            return await ctx.request_context.session.elicit_form(
                message, _FORM, ctx.request_context.request_id
            )
        except MCPError as error:
            return f"the client could not ask the person ({str(error)[:200]})"
    return f"the person did not answer within {ASK_TIMEOUT_S:g} s"


async def _settle(
    recording: RecordingAccess, needed: ConsentRequiredError, answer: ElicitResult | str
) -> None:
    """Record an answer.

    Raises:
        NotAllowedError: It is not that the person agrees.
    """
    declined = answer if isinstance(answer, str) else None
    if isinstance(answer, ElicitResult) and answer.action != "accept":
        declined = "the person declined" if answer.action == "decline" else "the person cancelled"
    with anyio.CancelScope(shield=True):
        await anyio.to_thread.run_sync(note_answer, recording, needed, declined)
    if declined is not None:
        text = f"{declined[0].upper()}{declined[1:]}: {needed}"
        raise NotAllowedError(text, needed.rule)


def _interim(message: str, agreed: list[str], needed: ConsentRequiredError) -> InputRequiredResult:
    """Return the question, for a client that makes the call again with the answer."""
    asked = _AskedFor(
        agreed=agreed,
        rule=needed.rule,
        text=str(needed),
        request_id=needed.request_id,
    )
    form = ElicitRequestFormParams(message=message, requested_schema=_FORM)
    return InputRequiredResult(
        input_requests={_QUESTION: ElicitRequest(params=form)},
        request_state=asked.model_dump_json(),
    )


async def _agreed_before(ctx: Context[Any], recording: RecordingAccess) -> list[str]:
    """Return the rules to which the person has agreed in the rounds before of this call."""
    state, answers = ctx.request_state, ctx.input_responses or {}
    if state is None:
        return []
    asked = _AskedFor.model_validate_json(state)
    answer = answers.get(_QUESTION)
    needed = ConsentRequiredError(asked.text, asked.rule)
    needed.request_id = asked.request_id
    given = answer if isinstance(answer, ElicitResult) else "the person did not answer"
    await _settle(recording, needed, given)
    return [*asked.agreed, asked.rule]
