"""The console commands.

The commands are a table in `commands`; what one needs is imported inside it, so that each answers
at once, and `--version` before anything else is imported. Errors of webots-mcp end it with one line
on stderr and exit code 2, refusals of the system (a full disk) and missing packages with 1, Ctrl-C
and SIGTERM with 130 and 143.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from webots_mcp.errors import InvalidInputError, NotAllowedError, WebotsMCPError

if TYPE_CHECKING:
    import re

    from cyclopts import App, Argument, CycloptsError

    from webots_mcp.cli.commands import CommandEntry

_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})
EXIT_SYSTEM: Final = 1
EXIT_BAD_INPUT: Final = 2
_HELP: Final = """Flight recorder and remote control for Webots simulations.

Controllers record into one SQLite database. An AI assistant reads it, and steers the simulation,
over MCP. Try `webots-mcp demo` first. For the options of a command use `webots-mcp COMMAND --help`;
for the documentation of a topic use `webots-mcp help TOPIC`.
"""
_HELP_OF_A_FEW: Final = (
    "\nThese are the everyday commands; `webots-mcp --help --all` lists all {number}.\n"
)
_HELP_OF_DISPLAY: Final = (
    "\nEvery command accepts `--verbose` (show all columns and details, and where an error was "
    "raised) and `--no-color`.\n"
)


def names() -> list[str]:
    """Return the names of all commands."""
    from webots_mcp.cli import commands

    return sorted(commands.COMMANDS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    given = list(sys.argv[1:] if argv is None else argv)
    try:
        if given == ["--version"]:
            return _print_version()
        given = _take_global_options(given)
        return _run(given, is_process=argv is None)
    except NotAllowedError as error:  # quotes a line of a file exactly as it is written there
        return _fail(EXIT_BAD_INPUT, str(error), given)
    except WebotsMCPError as error:
        from webots_mcp.cli.wording import as_typed

        answer = getattr(error, "answer", {})
        return _fail(EXIT_BAD_INPUT, as_typed(str(error)), given, answer)
    except UnicodeEncodeError as error:  # arguments that are not valid text
        no_text = error.object[error.start : error.end]
        said = f"{no_text!r} cannot be written as {error.encoding}: {error.reason}"
        return _fail(EXIT_BAD_INPUT, said, given)
    except ModuleNotFoundError as error:
        return _fail(EXIT_SYSTEM, _explain_missing(error), given)
    except KeyboardInterrupt as interrupt:
        from webots_mcp.cli.interrupts import ended_by

        return _end(*ended_by(interrupt))
    except BrokenPipeError:  # the reader of a pipe has closed it
        _discard_output()
    except OSError as error:
        return _fail(EXIT_SYSTEM, str(error), given)
    except Exception as error:  # noqa: BLE001  (raised again unless it is about a value)
        return _fail(EXIT_SYSTEM, _explain_value(error), given)
    return 0


def _print_version() -> int:
    from webots_mcp.contract import VERSION

    print(VERSION, flush=True)
    return 0


def _take_global_options(given: list[str]) -> list[str]:
    """Apply the global options.

    Return the remaining arguments, with current names for former ones.
    """
    from webots_mcp.cli.commands import FORMER_NAMES
    from webots_mcp.cli.terminal import Display, note_recording, set_display

    end = given.index("--") if "--" in given else len(given)
    options, rest = given[:end], given[end:]
    set_display(Display("--verbose" in options, "--no-color" not in options))
    note_recording("")
    options = [each for each in options if each not in ("--verbose", "--no-color")]
    if options and (name := FORMER_NAMES.get(options[0])):
        with contextlib.suppress(OSError):
            print(f"webots-mcp: {options[0]!r} is now called {name!r}", file=sys.stderr)
        options[0] = name
    return options + rest


def _run(argv: Sequence[str], *, is_process: bool) -> int:
    """Call the given command; without one, list the commands."""
    from cyclopts import CycloptsError, UnusedCliTokensError

    from webots_mcp.cli.commands import COMMANDS
    from webots_mcp.cli.interrupts import ending_by_signals
    from webots_mcp.cli.streams import spelling_out
    from webots_mcp.cli.wording import Typed, speak_of

    app = app_for(argv)
    if argv and argv[0] in COMMANDS:
        speak_of(
            Typed(
                each.field_info.name,
                each.names[0],
                called_value(each),
                next(iter(each.negatives), ""),
            )
            for each in app[argv[0]].assemble_argument_collection()
            if each.names
        )
    # Nothing here comes from a recording, so it may have colours.
    is_help = argv[:1] == ["help"] or not {"--help", "-h"}.isdisjoint(argv)
    if is_help:
        argv = [each for each in argv if each != "--all" or argv[0] in COMMANDS]
    ending = ending_by_signals(is_process=is_process)
    with ending, contextlib.nullcontext() if is_help else spelling_out():
        try:
            code = app(argv, exit_on_error=False, print_error=False, result_action="return_value")
        except UnusedCliTokensError as error:
            unused = " ".join(map(repr, error.unused_tokens or ()))
            raise InvalidInputError(f"{argv[0]} takes no further argument: {unused}") from error
        except CycloptsError as error:
            raise InvalidInputError(_named(error)) from error
        sys.stdout.flush()
    return code or (0 if argv else EXIT_BAD_INPUT)


def _named(error: CycloptsError) -> str:
    """Describe an error with the argument that caused it: cyclopts omits some names."""
    import re

    text = re.sub(r' Did you mean "?([^\s"?]+)"?\?', _harmless_offer, str(error))
    argument = error.argument
    if argument is None or any(name in text for name in argument.names):
        return text
    return f"Invalid value for {argument.names[0]}: {text}"


def _harmless_offer(offer: re.Match[str]) -> str:
    """Return cyclopts' correction of an unknown name, unless it would destroy data."""
    from webots_mcp.signals.naming import is_destructive

    return "" if is_destructive(offer[1]) else offer[0]


def _fail(code: int, text: str, given: Sequence[str], answer: Mapping[str, Any] = _NOTHING) -> int:
    """End with an error, which programs read as JSON together with the outcome of a command."""
    if "--json" in given:
        import json

        from webots_mcp.signals.naming import spelled_out

        with contextlib.suppress(OSError):
            print(spelled_out(json.dumps({**answer, "error": text}, ensure_ascii=False)))
    return _end(code, text)


def _end(code: int, text: str) -> int:
    """Report the reason in one line.

    What could not be printed before is not retried at the exit.
    """
    from webots_mcp.signals.naming import spelled_out

    with contextlib.suppress(OSError):
        print(f"webots-mcp: {spelled_out(text)}", file=sys.stderr, flush=True)
        _print_details()
    try:
        sys.stdout.flush()
    except OSError:
        _discard_output()
    return code


def _print_details() -> None:
    """With `--verbose`, print which recording was read and where the error was raised."""
    import traceback

    from webots_mcp.cli.terminal import is_verbose, recording_read
    from webots_mcp.signals.naming import spelled_out

    error = sys.exc_info()[1]
    if not is_verbose() or error is None or isinstance(error, KeyboardInterrupt):
        return
    print(f"recording: {spelled_out(recording_read() or 'none was read')}", file=sys.stderr)
    lines = "".join(traceback.format_exception(error)).splitlines()
    print("\n".join(map(spelled_out, lines)), file=sys.stderr, flush=True)


def _explain_missing(error: ModuleNotFoundError) -> str:
    """Name the missing packages, and the line that installs them.

    Raises:
        ModuleNotFoundError: Raised again if it is a defect of webots-mcp.
    """
    if (error.name or "").partition(".")[0] == "webots_mcp":
        raise error
    from webots_mcp.extras.requirements import (
        checkout,
        install_line,
        missing_requirements,
        package_of,
    )

    wanted = missing_requirements()
    if not wanted:
        return (
            f"the Python package {error.name!r} is missing: install webots-mcp with what it "
            f"depends on, by {install_line([checkout()])}"
        )
    names = ", ".join(map(package_of, wanted))
    return (
        f"this command needs packages that a bridge does without, and they are missing: {names}. "
        f"Install them with\n\n    {install_line(wanted)}\n"
    )


def _explain_value(error: Exception) -> str:
    """Return what is most likely wrong with the recording, and where it shows.

    Raises:
        Exception: Raised again if it is not about a value of a row.
    """
    import traceback

    from webots_mcp.store.recording import is_invalid_value

    if not is_invalid_value(error):
        raise error
    frame, what = traceback.extract_tb(error.__traceback__)[-1], type(error).__name__
    return (
        "a row holds what no bridge has written, or webots-mcp has a defect: "
        f"{what} in {frame.name}, line {frame.lineno}: {error}"
    )


def _discard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# -- commands as cyclopts knows them
# -----------------------------------------------------------------


def app_for(argv: Sequence[str], *, shows_all: bool = False) -> App:
    """Return the application with the commands that a command line needs.

    Args:
        argv: Only the called command, or for its help those of everyday use (`--all`: all).
        shows_all: Whether to include all commands, for completion and documentation.
    """
    from cyclopts import App, Group, Parameter

    from webots_mcp.cli.commands import COMMANDS, EVERYDAY, GROUPS
    from webots_mcp.contract import VERSION

    called = argv[0] if argv else ""
    is_short = called in ("", "--help", "-h") and "--all" not in argv and not shows_all
    of_a_few = _HELP_OF_A_FEW.format(number=len(COMMANDS)) if is_short else ""
    app = App(
        name="webots-mcp",
        help=f"{_HELP}{of_a_few}{_HELP_OF_DISPLAY}",
        version=VERSION,
        version_flags=["--version"],
        suppress_keyboard_interrupt=False,
        default_parameter=Parameter(negative=(), show_default=False),
    )
    names = [called] if called in COMMANDS else list(EVERYDAY) if is_short else list(COMMANDS)
    groups = {name: Group(name, sort_key=place) for place, name in enumerate(GROUPS)}
    is_list = is_short and len(argv) < 2  # nothing but sentences is shown of any command
    for name in names:
        command = COMMANDS[name]
        group = groups[command.group]
        if is_list:
            app.command(_only_listed, name=name, group=group, help=EVERYDAY[name])
        else:
            app.command(_function_of(command), name=name, group=group)
    return app


def _only_listed() -> None:
    """Stand for a command in the list of commands."""


def _function_of(command: CommandEntry) -> Callable[..., Any]:
    """Return the function of a command, with the parameters that are its options."""
    import inspect

    found = command.declared()
    if inspect.isfunction(found):
        return found
    from webots_mcp.cli.question_commands import command_of

    return command_of(found)


class CommandHelp(NamedTuple):
    """A command as its help describes it, with arguments by their spelling."""

    text: str
    arguments: dict[str, str]


def described() -> dict[str, CommandHelp]:
    """Return every command by its name."""
    import inspect

    from webots_mcp.cli.commands import COMMANDS

    app = app_for([], shows_all=True)
    return {
        name: CommandHelp(
            inspect.getdoc(_function_of(command)) or "",
            {
                _typed(each): each.parameter.help or ""
                for each in app[name].assemble_argument_collection()
                if each.show
            },
        )
        for name, command in sorted(COMMANDS.items())
    }


def called_value(argument: Argument) -> str:
    """Return the word for its value."""
    from webots_mcp.cli.wording import value_name

    metavar = getattr(argument.parameter, "metavar", None)  # missing in cyclopts 4
    return metavar if isinstance(metavar, str) else value_name(argument.names[-1])


def _typed(argument: Argument) -> str:
    """Return all names of an option, with a word for its value."""
    names = argument.names
    if argument.hint is bool or not names[0].startswith("-"):
        return ", ".join(names)
    value = "|".join(argument.get_choices() or [called_value(argument)])
    return ", ".join(f"{name} {value}" for name in names)
