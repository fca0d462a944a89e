"""Which plugins there are, and what each offers: commands, questions, export formats.

The core (bridge, store, server, command line) does not know them. It asks here, and imports a
plugin's code when it is used. A plugin names what it offers in `PLUGIN` of its `__init__`, by
modules and by functions as `module:function`; nothing else is imported with it, so that
`webots-mcp --help` and a server start as fast as without.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple

_FOLDER: Final = "webots_mcp.plugins"


class ExportFormat(NamedTuple):
    """A format of `webots-mcp export`.

    Attributes:
        name: As `--format` takes it.
        suffixes: The endings of files of this format, without the dot.
        write: For a table `write(table, sink)`, as `store.export.ExportTable`; for viewers
            `write(connection, data_dir, wanted, file, progress)`, as `export_for_viewers`.
        for_viewers: All of a range (poses, pictures, log lines), not a table of states or trials.
        passes: How often a table's rows are read for it.
        is_text: Whether a terminal can show it.
    """

    name: str
    suffixes: tuple[str, ...]
    write: str
    for_viewers: bool = False
    passes: int = 1
    is_text: bool = False


class PluginCommand(NamedTuple):
    """A command of a plugin.

    Attributes:
        name: As it is typed.
        group: Of the help: one of `cli.commands.GROUPS`.
        function: Its parameters are the options, its docstring the help; or a question.
    """

    name: str
    group: str
    function: str


class Plugin(NamedTuple):
    """What a plugin adds to the core.

    Attributes:
        commands: For the command line.
        questions: Modules that declare questions (`questions.declaration`), which are MCP tools.
        formats: Of exports.
        cluster: Where else trials can run: a context manager that gives
            `steering.trial_run.Simulators`, of a scheduler.
        stand_in: Runs a world without Webots, in the foreground: `run(world, mode, duration_s,
            controllers, recorder)`, which returns the exit code. The recorder has `begin(port)`,
            and `put(stream, line)` for each line of the console.
    """

    commands: tuple[PluginCommand, ...] = ()
    questions: tuple[str, ...] = ()
    formats: tuple[ExportFormat, ...] = ()
    cluster: str | None = None
    stand_in: str | None = None


@cache
def plugins() -> tuple[Plugin, ...]:
    """Return what each plugin offers, in the order of their names."""
    packages = pkgutil.iter_modules(import_module(_FOLDER).__path__)
    names = sorted(each.name for each in packages if each.ispkg)
    return tuple(import_module(f"{_FOLDER}.{name}").PLUGIN for name in names)


def load(name: str) -> Any:
    """Return what a plugin named as `module:function`."""
    return pkgutil.resolve_name(name)


def plugin_commands() -> tuple[PluginCommand, ...]:
    """Return the commands of all plugins."""
    return tuple(each for plugin in plugins() for each in plugin.commands)


def question_modules() -> Iterator[ModuleType]:
    """Import the plugins' questions."""
    return (import_module(name) for plugin in plugins() for name in plugin.questions)


def export_formats() -> tuple[ExportFormat, ...]:
    """Return the formats that plugins write."""
    return tuple(each for plugin in plugins() for each in plugin.formats)


def cluster_offered() -> str:
    """Return where trials run on other machines."""
    return next(plugin.cluster for plugin in plugins() if plugin.cluster is not None)


def stand_in_simulator() -> Callable[[Path, str, float | None, dict[str, str], object], int]:
    """Return what runs a world where no Webots is."""
    return load(next(each.stand_in for each in plugins() if each.stand_in))
