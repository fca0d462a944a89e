"""Turn questions into commands: options and help, the call, and the answer in a terminal.

Everything is derived from the question's declaration; nothing here knows any single question.
"""

from __future__ import annotations

import inspect
import json
import re
import shlex
import sys
import types
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from typing import Annotated, Any, Final, Literal, Union, get_args, get_origin

import anyio
from pydantic import ValidationError

from webots_mcp.cli.options import (
    Json,
    Parameter,
    TimeRangeOptions,
    Where,
    make_chunks_first,
    refuse_options,
    settings_of,
    value_of,
    whole_number,
)
from webots_mcp.cli.streams import line_of_progress, show_progress, wait
from webots_mcp.cli.terminal import print_answer, text_of
from webots_mcp.cli.wording import Typed, as_typed, running, speak_of, value_name
from webots_mcp.contract import LOOPING
from webots_mcp.errors import CommandRefusedError, InvalidInputError, NothingRecordedError
from webots_mcp.questions.argument_errors import faults_of
from webots_mcp.questions.arguments import FOR_A_PERSON, SCOPE
from webots_mcp.questions.declaration import Caller, Question, Reply
from webots_mcp.store.recording import OpenConnections, RecordingAccess

# Options of arguments that have another name in all questions.
OPTIONS: Final[Mapping[str, str]] = types.MappingProxyType(
    {
        "run_id": "--run",
        "last_s": "--last",
        "start_s": "--start",
        "end_s": "--end",
        "since_wall_time": "--since",
        "until_wall_time": "--until",
        "for_s": "--for",
        "timeout_wall_s": "--timeout",
        "kinds": "--kind",
        "signals": "--signal",
        "limit": "-n",
        "cursor": "--after",
        "trial_set": "--trials",
    }
)
_VALUE_NAMES: Final = {
    "_s": "S", "_m": "M", "_px": "PX", "limit": "N", "robot": "NAME", "run_id": "ID",
    "signals": "SIGNAL", "position": "X Y", "mode": "SIGNAL",
    "where": "CONDITION", "until": "CONDITION", "cursor": "CURSOR", "trial_set": "SET",
    "text": "TEXT", "note": "TEXT", "kinds": "KIND", "types": "TYPE", "names": "NAME",
    "fields": "FIELD",
}  # fmt: skip
_NAMES_OF_TYPES: Final[Mapping[Any, str]] = types.MappingProxyType(
    {int: "N", float: "X", str: "TEXT"}
)
# Default of arguments for which a model's client would stop waiting early, but a person would not.
_DEFAULTS: Final[Mapping[str, Any]] = types.MappingProxyType({"timeout_wall_s": 600.0})
_FOLLOW: Final = Annotated[
    bool,
    Parameter(
        "--follow", help="Keep printing new rows until Ctrl-C. With --json each is an object."
    ),
]


def command_of(question: Question) -> Callable[..., None]:
    """Return the function that the command line calls for a question."""

    def run(
        *positional: Any,
        span: TimeRangeOptions | None = None,
        recorded: Where | None = None,
        json: bool = False,
        follow: bool = False,
        **options: Any,
    ) -> None:
        given = _named(question, positional) | options | (vars(span) if span else {})
        if follow:
            return _follow(question, given, recorded or Where(), as_json=json)
        ask_and_show(question, given, recorded or Where(), as_json=json)

    speak_of(
        Typed(each.name, option, _value_name(each.name) or value_name(option))
        for each in question.parameters
        for option in [option_of(question, each.name)]
    )
    in_range = SCOPE if question.has_scope else ()
    parameters = [_parameter(question, e) for e in question.parameters if e.name not in in_range]
    parameters.sort(key=lambda each: (each.kind, *_place(question, each.name)))
    keyword = inspect.Parameter.KEYWORD_ONLY
    if in_range:
        parameters.append(
            inspect.Parameter(
                "span", keyword, default=TimeRangeOptions(), annotation=TimeRangeOptions
            )
        )
    if question.follows:
        parameters.append(inspect.Parameter("follow", keyword, default=False, annotation=_FOLLOW))
    parameters += [
        inspect.Parameter("json", keyword, default=False, annotation=Json),
        inspect.Parameter("recorded", keyword, default=Where(), annotation=Where),
    ]
    vars(run)["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    run.__name__ = question.command or question.name
    run.__doc__ = as_typed(inspect.getdoc(question.function) or "")
    if question.example:
        run.__doc__ += f"\n\n    webots-mcp {question.command} {question.example}"
    return run


def _named(question: Question, positional: Sequence[Any]) -> dict[str, Any]:
    """Return positional arguments by name; the last one takes the rest."""
    *single, last = question.positional or ("",)
    named = dict(zip(single, positional, strict=False))
    rest = positional[len(single) :]
    if rest:
        named[last] = list(rest) if _is_list(question, last) else rest[0]
    return named


def _is_list(question: Question, argument: str) -> bool:
    (declared,) = (each for each in question.parameters if each.name == argument)
    kind = _plain(declared.annotation)
    return get_origin(_without_none(kind)) is list or _is_mapping(kind)


def _without_none(kind: Any) -> Any:
    """Return the type of an optional argument without None."""
    kinds = [each for each in get_args(kind) if each is not type(None)]
    is_optional = get_origin(kind) in (Union, types.UnionType) and len(kinds) == 1
    return kinds[0] if is_optional else kind


def ask_and_show(
    question: Question, given: Mapping[str, Any], where: Where, *, as_json: bool
) -> None:
    """Answer a question and print the answer.

    Raises:
        WebotsMCPError: As for `ask` and `show`.
    """
    show(question, ask(question, given, where), where, as_json=as_json)


def ask(question: Question, given: Mapping[str, Any], where: Where) -> Reply:
    """Answer a question for a person: about any length of recording, without a time limit.

    Raises:
        InvalidInputError: An argument is out of bounds.
        NothingRecordedError: Nothing is recorded that the question is about.
        WebotsMCPError: As the question declares.
    """
    asks_controllers = question.has_caller  # reading also takes a row in the queue
    opened = where.recording(read_only=question.effect.reads and not asks_controllers)
    with closing(OpenConnections()) as connections:
        recording = replace(opened, connections=connections)
        valid = _valid(question, given, recording)
        if {"signals", "pattern"} & {each.name for each in question.parameters}:
            make_chunks_first(recording)
        with line_of_progress(), _caller(question, recording) as caller:
            return anyio.run(question.ask, recording, valid, caller)


@contextmanager
def _caller(question: Question, recording: RecordingAccess) -> Generator[Caller | None]:
    """Return the caller, if the question needs it; what it starts ends with the command."""
    if not question.has_caller:
        yield None
        return
    from webots_mcp.steering.launcher import Companions, Launcher
    from webots_mcp.steering.trial_worker import TrialWorkers

    companions = Companions(TrialWorkers(recording), Launcher(recording))
    try:
        yield Caller("cli", show_progress, companions)
    finally:
        companions.stop()


def _valid(
    question: Question, given: Mapping[str, Any], recording: RecordingAccess
) -> dict[str, Any]:
    """Return the arguments in the types of the question; others keep their defaults."""
    meant: dict[str, Any] = {}
    for parameter in question.parameters:
        value, kind = given.get(parameter.name), _plain(parameter.annotation)
        if value is None:
            value = _DEFAULTS.get(parameter.name)
        if value is None:
            continue
        if _is_mapping(kind) and not isinstance(value, Mapping):
            value = settings_of(value, _kinds_in(recording) if _is_of_parameters(kind) else {})
        elif _is_json(kind) and isinstance(value, str):
            value = value_of(value)
        meant[parameter.name] = value
    try:
        model = question.arguments.model_validate(meant, context=FOR_A_PERSON)
    except ValidationError as error:
        raise InvalidInputError(
            faults_of(
                error,
                {each.name: option_of(question, each.name) for each in question.parameters}
                | {each.name: each.typed for each in running()},
            )
        ) from error
    return {name: getattr(model, name) for name in question.arguments.model_fields}


def _kinds_in(recording: RecordingAccess) -> Mapping[str, str]:
    """Return the kinds of the parameters that robots have, by name."""
    from webots_mcp.store.run_parameters import kinds_of

    with recording.reader() as connection:
        return kinds_of(connection)


def show(question: Question, reply: Reply, where: Where, *, as_json: bool) -> None:
    """Print an answer.

    Raises:
        CommandRefusedError: The answer is about a command that was not carried out.
        NothingRecordedError: Nothing was recorded, and the answer only says why.
    """
    data = reply.data
    if data is None:
        return print(*(each for each in reply.shown if isinstance(each, str)), sep="\n")
    _require_recorded(data)
    if data.get("outcome") in ("failed", "expired", "cancelled", "lost", "claimed"):
        refused = CommandRefusedError(_not_done(question, data, where))
        refused.answer = {name: value for name, value in data.items() if name != "hint"}
        raise refused
    if as_json:
        print(json.dumps(data, ensure_ascii=False))
    else:
        print_answer(data)


def _not_done(question: Question, answer: Mapping[str, Any], where: Where) -> str:
    """Return the outcome of a command that was not carried out, and what to do next."""
    is_under_way = answer["outcome"] == "claimed" and "command_id" in answer
    hint = _under_way(answer, where) if is_under_way else answer.get("hint")
    failed = (f"{route}: {reason}" for route, reason in answer.get("failed_routes", {}).items())
    why = "; ".join(filter(None, (answer.get("error"), hint, *failed))) or "no answer in time"
    return f"{answer.get('action') or question.name} is not done ({answer['outcome']}): {why}"


def _under_way(answer: Mapping[str, Any], where: Where) -> str:
    """Return the command lines that continue waiting, and that free the loop."""
    wait = shlex.join(["webots-mcp", "wait", str(answer["command_id"]), *where.typed()])
    robot = ["--robot", answer["robot"]] if "robot" in answer else []
    end = shlex.join(["webots-mcp", "pause", *robot, *where.typed()])
    is_loop = answer.get("action") in LOOPING
    ending = f"\nor end it with\n\n    {end}\n" if is_loop else ""
    return (
        "the controller is still busy with it and goes on: do not send it again, but go on "
        f"waiting with\n\n    {wait}\n{ending}"
    )


def _require_recorded(data: Mapping[str, Any]) -> None:
    if data.get("status") == "never seen" and set(data) == {"summary", "status", "hint"}:
        raise NothingRecordedError(data["hint"])


def _follow(question: Question, given: dict[str, Any], where: Where, *, as_json: bool) -> None:
    """Show an answer, then new rows of its robot as they arrive.

    It ends after the answer if nothing can be written to the recording.

    Raises:
        BrokenPipeError: The reader has closed the pipe.
    """
    assert question.follows is not None
    if given.get("cursor") is not None:
        option = option_of(question, "cursor")
        raise InvalidInputError(f"--follow shows what comes: leave out {option}, which looks back")
    reply = ask(question, given, where)
    data = reply.data or {}
    _require_recorded(data)
    if as_json:
        _print_rows(_rows_in(data, question.follows), as_json=True)
    else:
        show(question, reply, where, as_json=False)
        sys.stdout.flush()
    new = _NewRows()
    new.of(_rows_in(data, question.follows))
    bounds = question.arguments.model_fields[question.follows].metadata
    most = max(each.le for each in bounds if hasattr(each, "le"))
    again = given | {question.follows: most} | {"robot": data.get("robot") or given.get("robot")}
    is_live = where.may_change()
    flood = "more than {} rows came at once: --before {} shows those that were left out"
    while is_live:
        wait(0.5)
        rows = _rows_in(ask(question, again, where).data or {}, question.follows)
        came = new.of(rows)
        if came and len(came) == most:
            print(f"webots-mcp: {flood.format(most, came[0]['id'])}", file=sys.stderr)
        _print_rows(came, as_json=as_json)


class _NewRows:
    """Find which of the newest rows are new."""

    def __init__(self) -> None:
        self._newest: dict[bool, int] = {}

    def of(self, rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
        """Return the new rows; rows that wait for a run have numbers of their own."""
        new = [row for row in rows if row["id"] > self._newest.get(row["run_id"] is None, 0)]
        for row in new:
            self._newest[row["run_id"] is None] = row["id"]
        return new


def _rows_in(data: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    table: dict[str, list[Any]] = data.get(name) or {"columns": [], "rows": []}
    return [dict(zip(table["columns"], values, strict=True)) for values in table["rows"]]


def _print_rows(rows: Sequence[Mapping[str, Any]], *, as_json: bool) -> None:
    for row in rows:
        if as_json:
            print(json.dumps(row, ensure_ascii=False), flush=True)
        else:
            shown = (text_of(value) or "-" for name, value in row.items() if name != "id")
            print(*shown, flush=True)


def option_of(question: Question, argument: str) -> str:
    """Return the option of an argument as it is typed, or its name in the help."""
    own = question.options or {}
    if argument in own:
        return own[argument]
    if argument in question.positional:
        return argument.upper()
    words = argument.replace("_", "-")
    is_on = question.arguments.model_fields[argument].default is True
    return OPTIONS.get(argument) or (f"--no-{words}" if is_on else f"--{words}")


def _parameter(question: Question, declared: inspect.Parameter) -> inspect.Parameter:
    name, kind = declared.name, _plain(declared.annotation)
    if _is_mapping(kind):
        kind = list[str] | None
    elif number := _number_of_items(question, name):
        kind = tuple[(str,) * number]
    elif _is_json(kind):
        kind = str if declared.default is inspect.Parameter.empty else str | None
    text = _help_of(question, name)
    default = declared.default if isinstance(declared.default, bool) else None
    if declared.default is inspect.Parameter.empty:
        default = inspect.Parameter.empty
    elif not isinstance(usual := _DEFAULTS.get(name, declared.default), bool) and usual:
        text += f" Default: {usual:g}." if isinstance(usual, float) else f" Default: {usual}."
    text = text.replace("*", r"\*")  # help is Markdown, where two asterisks would mean emphasis
    if default is None and type(None) not in get_args(kind):
        kind = Union[kind, None]  # noqa: UP007
    option = option_of(question, name)
    place = inspect.Parameter.KEYWORD_ONLY
    if name in question.positional and _is_list(question, name):
        kind, default = get_args(_without_none(kind))[0], inspect.Parameter.empty
        converter = whole_number if kind is int else None
        shown = Parameter(option, help=text, converter=converter)
        place = inspect.Parameter.VAR_POSITIONAL
    elif name in question.positional:
        shown = Parameter(
            option, help=text, negative=(), allow_leading_hyphen=True, validator=refuse_options,
            converter=whole_number if _without_none(kind) is int else None,
        )  # fmt: skip
        place = inspect.Parameter.POSITIONAL_ONLY
    elif default is True:  # its option turns it off
        text += f" This is the default; {option} turns it off."
        shown = Parameter(f"--{name.replace('_', '-')}", help=text, negative=option)
    else:
        converter = whole_number if _without_none(kind) is int else None
        is_text = _without_none(kind) is str
        shown = Parameter(
            option, help=text, negative=(), converter=converter,
            metavar="NAME=VALUE"
            if _is_mapping(_plain(declared.annotation))
            else _value_name(name) or _NAMES_OF_TYPES.get(_without_none(kind)),
            allow_leading_hyphen=is_text, validator=refuse_options if is_text else None,
        )  # fmt: skip
    return inspect.Parameter(name, place, default=default, annotation=Annotated[kind, shown])


def _help_of(question: Question, argument: str) -> str:
    """Return the description of an argument, with examples as typed."""
    text = as_typed(question.described(argument))
    text = re.sub(r"\{['\"](\w+)['\"]: ([^{},]+)\}", r"\1=\2", text)
    return re.sub(r"\['(\w+)'\]", r"\1", text)


def _value_name(argument: str) -> str | None:
    """Return the word for its value in the help; None for the name of its type."""
    return next((name for end, name in _VALUE_NAMES.items() if argument.endswith(end)), None)


def _place(question: Question, argument: str) -> list[int]:
    """Return its position among the positional arguments."""
    return [place for place, name in enumerate(question.positional) if name == argument]


def _plain(annotation: Any) -> Any:
    """Return the type without pydantic's annotations."""
    if get_origin(annotation) is Annotated:
        return _plain(get_args(annotation)[0])
    if get_origin(annotation) in (Union, types.UnionType):
        return Union[tuple(_plain(each) for each in get_args(annotation))]  # noqa: UP007
    if get_origin(annotation) is list:
        return list[_plain(get_args(annotation)[0])]
    return annotation


def _number_of_items(question: Question, argument: str) -> int | None:
    """Return the number of items of an argument that always has the same number of them."""
    bounds = question.arguments.model_fields[argument].metadata
    least, most = (
        next((getattr(each, name) for each in bounds if hasattr(each, name)), None)
        for name in ("min_length", "max_length")
    )
    return most if most == least else None


def _is_mapping(kind: Any) -> bool:
    each = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    kinds = [one for one in each if one is not type(None)]
    return len(kinds) == 1 and get_origin(kinds[0]) is dict


def _is_of_parameters(kind: Any) -> bool:
    """Return whether a mapping holds values of parameters, which have declared kinds."""
    return get_args(_without_none(kind))[1] is not Any


def _is_json(kind: Any) -> bool:
    """Return whether several types are possible, so that JSON decides which one was typed."""
    each = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    kinds = [one for one in each if one is not type(None)]
    return kinds == [Any] or (len(kinds) > 1 and all(get_origin(k) is not Literal for k in kinds))
