"""Record requests that change something, and check each of them by the policy.

A request begins with a tool, a command line or the page. Every part of it that has an effect (a
queued command, a started Webots, an order to it, a stored breakpoint) calls `permit` first, which
finds the request of its task. So no route avoids the policy.
"""

from __future__ import annotations

import json
import re
import sqlite3
import time
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, cast

from anyio import CancelScope, to_thread

from webots_mcp.contract import VERSION, new_uuid
from webots_mcp.errors import ConsentRequiredError, DatabaseError, NoDatabaseError, NotAllowedError
from webots_mcp.store.policy import LAUNCH, Policy, policies_of
from webots_mcp.store.recording import RecordingAccess

_SECRET: Final = re.compile(
    r"token|passw|passphrase|secret|credential|authori[sz]ation|bearer|"
    r"(^|[_\W])(pwd|pass|auth)($|[_\W\d])|(^|[_\W])key|key$|apikey",
    re.IGNORECASE,
)
# parts of an address that is an argument
_PASSWORD: Final = re.compile(r"(?<=://)[^/\s:@\"']*:[^/\s@\"']+(?=@)")
_LEFT_OUT: Final = "(left out)"
AGREED: Final = "the person agreed"
_ASKED: Final = "the person is asked"
_END: Final = "UPDATE request SET finished_wall_time_s = ?, outcome = ? WHERE id = ?"


@dataclass(frozen=True)
class RequestLimits:
    """Lengths of what is stored of a request, in characters.

    Attributes:
        arguments: Length at which the arguments are cut.
        outcome: Length at which the outcome is cut.
        secret: Shortest secret that is removed; removing shorter ones would remove words.
    """

    arguments: int = 1_000
    outcome: int = 300
    secret: int = 4


_LIMITS: Final = RequestLimits()


class Requester(NamedTuple):
    """The caller: a program by its name and version, and its transport.

    Attributes:
        transport: `stdio` or `http` of an MCP client, `cli` or `page`.
    """

    name: str
    version: str
    transport: str


BY_COMMAND_LINE: Final = Requester("webots-mcp", VERSION, "cli")


class Consent:
    """The consent of a person, who can be asked during a call of a client.

    Attributes:
        agreed: The rules to which the person has agreed for this call.
        can_ask: Whether a client waits for the answer and can ask the person.
    """

    def __init__(self, agreed: Collection[str], *, can_ask: bool = True) -> None:
        self.agreed = frozenset(agreed)
        self.can_ask = can_ask

    @contextmanager
    def given(self) -> Generator[None]:
        """Make the consent available to requests that begin in the block."""
        token = _consent.set(self)
        try:
            yield
        finally:
            _consent.reset(token)
            self.can_ask = False


_NOBODY: Final = Consent((), can_ask=False)
_consent: Final[ContextVar[Consent]] = ContextVar("consent", default=_NOBODY)


class OpenRequest:
    """A request during its block; a thread that continues it runs in its context.

    Args:
        recording: The recording that it changes, or whose simulation it changes.
        by: The caller.
        names: The name of the tool or command, and of the tool that it is a part of.
        arguments: The arguments as given.
        reads: Whether it changes nothing; then it has no row unless it is refused.
    """

    def __init__(
        self,
        recording: RecordingAccess,
        by: Requester,
        names: Sequence[str],
        arguments: Mapping[str, Any],
        *,
        reads: bool = False,
    ) -> None:
        self.recording = recording
        self.id: int | None = None
        self.outcome = "answered"
        self._by, self._names, self._reads = by, names, reads
        self._arguments = arguments
        self._consent = _consent.get()
        self._used_consent = False
        self._permitted = set[str]()

    def __enter__(self) -> OpenRequest:
        self._begin()
        self._token = _open.set(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        _open.reset(self._token)
        self._end(error)

    async def __aenter__(self) -> OpenRequest:
        if self._reads:
            self._begin()
        else:
            await to_thread.run_sync(self._begin)
        self._token = _open.set(self)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        _open.reset(self._token)
        if not self._reads:
            with CancelScope(shield=True):
                await to_thread.run_sync(self._end, error)

    def enter(self, *, create: bool = False) -> None:
        """Ensure that the request has a row; without a database only if one is to be created."""
        if self.id is not None or self._reads or self.recording.read_only:
            return
        if create:
            self.recording.create()
        with suppress(NoDatabaseError):
            self._insert()

    def require(self, action: str, params: Mapping[str, Any], steered: Path | None = None) -> None:
        """Check that the policy allows an action; see `permit`.

        Raises:
            NotAllowedError: The policy forbids it; the row records that.
            ConsentRequiredError: A rule needs the person's consent, which is requested before
                anything else.
        """
        world = params.get("world") if action in (LAUNCH, "load_world") else None
        with self._refusing(is_first=self._permitted <= {action}):
            found = self._policies(*(str(file) for file in (world, steered) if file))
            self._check(found, lambda policy: policy.require(action, params, self._names))
        self._permitted.add(action)

    def _begin(self) -> None:
        with self._refusing():
            self._check(self._policies(), lambda policy: policy.require_tool(self._names))
        self.enter()

    def _check(self, policies: Sequence[Policy], require: Callable[[Policy], None]) -> None:
        """Check all rules first, so that nobody is asked about what another rule forbids."""
        needed: dict[str, ConsentRequiredError] = {}
        while True:
            try:
                for policy in policies:
                    require(policy.with_consent(needed))
                break
            except ConsentRequiredError as error:
                needed[error.rule] = error
        for rule, error in needed.items():
            if rule not in self._consent.agreed:
                raise error
        self._used_consent |= bool(needed)

    def _policies(self, *files: str) -> list[Policy]:
        """Return the policies that bind the caller; a reading request ignores invalid ones."""
        if not self._reads:  # which began in the event loop
            with suppress(NoDatabaseError), self.recording.reader() as connection:
                query = (
                    "SELECT world FROM run WHERE ended_wall_time_s IS NULL AND world IS NOT NULL "
                    "UNION SELECT controller FROM session WHERE ended_wall_time_s IS NULL "
                    "AND controller IS NOT NULL"
                )
                files += tuple(file for (file,) in connection.execute(query).fetchall())
        found = policies_of(self.recording.database, self.recording.data_dir, files)
        try:
            return [each for each in found if each.holds_for(self._by.transport)]
        except NotAllowedError:
            if self._reads:
                return []
            raise

    @contextmanager
    def _refusing(self, *, is_first: bool = True) -> Generator[None]:
        """Record a refusal, also for a request that was answered while trials continued.

        A person's consent leads to a repeated request, so nothing of it may have been done before.
        """
        try:
            yield
        except NotAllowedError as error:
            if isinstance(error, ConsentRequiredError):
                if self._consent.can_ask and is_first:
                    self._note_question(error)
                    raise
                raise_as = NotAllowedError(str(error), error.rule)
            else:
                raise_as = error
            self.outcome = "refused"
            with suppress(DatabaseError):  # a refusal holds, whether or not it can be written
                if self.id is None:
                    self._insert()
                with self.recording.brief_writer() as connection:
                    connection.execute(
                        "UPDATE request SET rule = ? WHERE id = ?", (_bounded(error.rule), self.id)
                    )
                    connection.execute(_END, (time.time(), "refused", self.id))
            if raise_as is error:
                raise
            raise raise_as from error

    def _note_question(self, error: ConsentRequiredError) -> None:
        """Record that the person is asked, before asking."""
        self.outcome = _ASKED
        with suppress(DatabaseError):
            if self.id is None:
                self._insert()
            with self.recording.brief_writer() as connection:
                outcome = _bounded(f"{_ASKED}, by {error.rule}")
                connection.execute(_END, (time.time(), outcome, self.id))
        error.request_id = self.id

    def _insert(self) -> None:
        row = {
            "uuid": new_uuid(),
            "now": time.time(),
            "client": _bounded(self._by.name),
            "version": _bounded(self._by.version),
            "transport": self._by.transport,
            "tool": self._names[0],
            "arguments": recorded_arguments(self._arguments),
            "robot": self._arguments.get("robot"),
        }
        with self.recording.brief_writer() as connection:
            self.id = connection.execute(
                "INSERT INTO request (uuid, wall_time_s, client, client_version, transport, "
                "tool, arguments, run_id, sim_time_s) SELECT :uuid, :now, :client, :version, "
                ":transport, :tool, :arguments, r.id, coalesce((SELECT sim_time_s FROM state "
                "WHERE run_id = r.id ORDER BY id DESC LIMIT 1), r.last_sim_time_s) FROM (SELECT "
                "1) LEFT JOIN (SELECT run.* FROM run JOIN robot b ON b.id = run.robot_id WHERE "
                "run.ended_wall_time_s IS NULL AND (:robot IS NULL OR b.name = :robot) ORDER BY "
                "run.id DESC LIMIT 1) r",
                row,
            ).lastrowid

    def _end(self, error: BaseException | None) -> None:
        if self.id is None and error is None:
            self.enter()  # the database was created meanwhile
        if self.id is None or self.outcome in ("refused", _ASKED):
            return
        if error is not None:
            # otherwise the client has cancelled the request or left
            known = isinstance(error, Exception)
            self.outcome = f"{type(error).__name__}: {error}" if known else "cancelled"
        if self._used_consent:
            self.outcome = f"{AGREED}: {self.outcome}"
        self.outcome = _PASSWORD.sub(_LEFT_OUT, self.outcome)
        for secret in _secrets_in(self._arguments):
            self.outcome = self.outcome.replace(secret, _LEFT_OUT)
        with suppress(DatabaseError), self.recording.brief_writer() as connection:
            connection.execute(_END, (time.time(), _bounded(self.outcome), self.id))


_open: Final[ContextVar[OpenRequest]] = ContextVar("request")


def permit(
    recording: RecordingAccess,
    action: str,
    params: Mapping[str, Any],
    *,
    create: bool = False,
    steered: Path | None = None,
) -> int | None:
    """Check that an action is allowed, and that the request behind it has a row.

    Args:
        recording: The recording whose simulation is changed.
        action: The action as a command names it, or `policy.LAUNCH`.
        params: Its parameters.
        create: Whether to create the database if there is none; otherwise the action has no row.
        steered: The world of the Webots that acts, which may belong to another project.

    Returns:
        The id of the request's row; None if it only reads, or without a database.

    Raises:
        NotAllowedError: A rule of the project's file forbids the action.
        ConsentRequiredError: A rule needs the person's consent first.
        LookupError: No request has begun, which is a defect of the program.
    """
    request = _open.get()
    request.require(action, params, steered)
    request.enter(create=create)
    return request.id


def note_answer(
    recording: RecordingAccess, error: ConsentRequiredError, declined: str | None
) -> None:
    """Record what the person answered, in the row of the request that asked.

    Args:
        recording: The recording of the request.
        error: The question.
        declined: Why the request is refused; None if the person agreed.
    """
    if error.request_id is None:
        return
    rule = None if declined is None else _bounded(error.rule)
    outcome = f"{AGREED}, by {error.rule}" if declined is None else f"refused: {declined}"
    with suppress(DatabaseError), recording.brief_writer() as connection:
        connection.execute(
            "UPDATE request SET rule = ?, outcome = ?, finished_wall_time_s = ? WHERE id = ?",
            (rule, _bounded(outcome), time.time(), error.request_id),
        )


def newest_requests(
    connection: sqlite3.Connection, limit: int, *, refused: bool = False
) -> list[dict[str, Any]]:
    """Return the newest requests, newest first, with the commands that they sent."""
    cursor = connection.execute(
        "SELECT id, wall_time_s, sim_time_s, run_id, client, client_version, transport, tool, "
        "arguments, rule, outcome, (SELECT json_group_array(json_array(id, action, status)) FROM "
        "(SELECT value ->> 0 AS id, value ->> 1 AS action, value ->> 2 AS status "
        "FROM json_each(coalesce(request.purged_commands, '[]')) UNION ALL "
        "SELECT id, action, status FROM command WHERE request_id = request.id ORDER BY id)) "
        "FROM request WHERE (:refused = 0 OR rule IS NOT NULL) ORDER BY id DESC LIMIT :limit",
        {"limit": limit, "refused": refused},
    )
    names = [column[0] for column in cursor.description[:-1]]
    return [
        {
            **dict(zip(names, row, strict=False)),
            "arguments": json.loads(row[8]),
            "commands": json.loads(row[-1]),
        }
        for row in cursor.fetchall()
    ]


# -- recorded arguments: without secrets, and cut where they are long --


def recorded_arguments(arguments: Mapping[str, Any]) -> str:
    """Return arguments as JSON without secrets, cut where they are long."""
    text = _PASSWORD.sub(_LEFT_OUT, _as_json(_without_secrets(arguments)))
    return text if len(text) <= _LIMITS.arguments else _as_json({"cut": text[: _LIMITS.arguments]})


def _as_json(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text.encode("utf-8", "replace").decode()


def _without_secrets(value: Any) -> Any:
    if isinstance(value, Mapping):
        items = cast("Mapping[Any, Any]", value).items()
        return {
            str(name): _LEFT_OUT if _SECRET.search(str(name)) else _without_secrets(each)
            for name, each in items
            if each is not None
        }
    if isinstance(value, (list, tuple)):
        return [_without_secrets(each) for each in cast("Sequence[Any]", value)]
    return value


def _secrets_in(value: Any, *, is_secret: bool = False) -> Generator[str]:
    """Yield the secret texts, which an error may repeat."""
    if isinstance(value, Mapping):
        for name, each in cast("Mapping[Any, Any]", value).items():
            yield from _secrets_in(each, is_secret=is_secret or bool(_SECRET.search(str(name))))
    elif isinstance(value, (list, tuple)):
        for each in cast("Sequence[Any]", value):
            yield from _secrets_in(each, is_secret=is_secret)
    elif is_secret and len(str(value)) >= _LIMITS.secret:
        yield str(value)


def _bounded(text: str) -> str:
    return text[: _LIMITS.outcome].encode("utf-8", "replace").decode()
