"""What the code adds to the pages of the site: it is read from the code as it is today."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import anyio

import webots_mcp
from webots_mcp import MemoryDatabase, testing
from webots_mcp.answers.answer_models import Answer, AnswerPart
from webots_mcp.answers.columns import COLUMNS
from webots_mcp.cli import described
from webots_mcp.cli.commands import COMMANDS, DATA, NOW, PAST, RUNS, SERVER, START, STEER
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.judging.checks.check_run import CHECKS
from webots_mcp.judging.detection.event_kinds import KINDS
from webots_mcp.plugins.prove.fact_checks import CHECKS as PROVEN
from webots_mcp.plugins.prove.fact_checks import NOT_TRIED
from webots_mcp.questions import all_questions
from webots_mcp.server.mcp_server import create_server
from webots_mcp.signals.meaning import QUANTITIES, ROLES, SIDES, short_forms, understood_words
from webots_mcp.testing import pytest_plugin

_COMMENT: Final = re.compile(r"/\*(.*?)\*/", re.DOTALL)
DOCS: Final = Path(__file__).parent
# Of docs/tools.md and of the help, by the pages in docs/tools and docs/command-line.
HEADINGS: Final = {
    "now": "What happens now", "past": "What happened before", "steering": "Steering",
}  # fmt: skip
COMMAND_GROUPS: Final = {
    "start": START, "watch": NOW, "ask": PAST, "steer": STEER, "experiments": RUNS,
    "recordings": DATA, "server": SERVER,
}  # fmt: skip
_TOC: Final = "```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{pages}\n```\n"


def navigation(index: str) -> str:
    """The tree of pages, from the lists of links of the first page."""
    parts = re.findall(r"(?ms)^## (.+?)\n(.*?)(?=^## |\Z)", index)
    return "\n".join(
        _TOC.format(caption=caption, pages="\n".join(re.findall(r"(?m)^- \[.+?\]\((.+?)\)", part)))
        for caption, part in parts
    )


def subpages(folder: str) -> str:
    """The tree of the pages in a folder next to a page, as its links name them."""
    pages = "\n".join(sorted(f"{folder}/{file.stem}" for file in (DOCS / folder).glob("*.md")))
    return f"```{{toctree}}\n:hidden:\n\n{pages}\n```\n"


def tools(heading: str | None = None) -> str:
    """Each tool as it describes itself to a client.

    Args:
        heading: Only those that docs/tools.md lists below this heading.
    """
    wanted = None if heading is None else tools_below(heading)
    memory = MemoryDatabase()
    try:
        server = create_server(memory, memory.data_dir)
        listed = sorted(anyio.run(server.list_tools), key=lambda tool: tool.name)
    finally:
        memory.close()
    shown = (tool for tool in listed if wanted is None or tool.name in wanted)
    return "## Reference\n\n" + "\n".join(map(_tool, shown))


def tools_below(heading: str) -> set[str]:
    """The tools that the lists of docs/tools.md name below a heading."""
    text = (DOCS / "tools.md").read_text("utf-8")
    part = text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    rows = re.findall(r"(?m)^- (`webots_.*?`) \(", part)
    return {name for row in rows for name in re.findall(r"webots_\w+", row)}


def _tool(tool: Any) -> str:
    required = tool.input_schema.get("required", ())
    arguments = [
        (f"`{name}` ({_kind(schema)}{', required' if name in required else ''})",
         schema.get("description", "") + _default(schema))
        for name, schema in tool.input_schema["properties"].items()
    ]  # fmt: skip
    return f"### {tool.name}\n\n{as_markdown(tool.description)}\n\n{_list(arguments)}"


def _list(entries: list[tuple[str, str]]) -> str:
    """Names with their meaning, which fit a telephone where a table would not."""
    return "".join(f"- {name}: {escaped(' '.join(text.split()))}\n" for name, text in entries)


def _kind(schema: dict[str, Any]) -> str:
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(_kind(each) for each in schema["anyOf"])
    kind = str(schema.get("type", "any"))
    if "items" in schema:
        kind = f"list of {_kind(schema['items'])}"
    least, most = schema.get("minimum"), schema.get("maximum")
    between = [f"from {least:g}"] if least is not None else []
    between += [f"to {most:g}"] if most is not None else []
    return " ".join([kind, *between])


def _default(schema: dict[str, Any]) -> str:
    """The default, unless the description gives it."""
    default = schema.get("default")
    is_said = "default" in schema.get("description", "").lower()
    return "" if default is None or is_said else f" Default: `{default}`."


def fields(_page: str = "") -> str:
    """Each field and column of each answer with its meaning; shared fields stand once."""
    parts, shown = ["## Reference\n"], dict[int, str]()
    for model in answer_models():
        own = {name: each for name, each in model.model_fields.items() if _is_own(model, name)}
        rows = [[f"`{n}`", _plain_type(each), each.description or ""] for n, each in own.items()]
        table = _table(["field", "type", "meaning"], rows) if rows else ""
        parts.append(
            f"### {model.__name__}\n\n{inspect.getdoc(model)}{_based_on(model)}\n\n{table}"
        )
        parts += [_columns(f"{model.__name__}.{name}", shown) for name in own]
    return "\n".join(parts)


def _columns(field: str, shown: dict[int, str]) -> str:
    """Return the columns of a field that is a table; those that were shown before by their name."""
    columns = COLUMNS.get(field)
    if columns is None:
        return ""
    name = field.partition(".")[2]
    if (before := shown.setdefault(id(columns), field)) != field:
        return f"Columns of `{name}`: as those of `{before}`.\n"
    rows = [[f"`{column}`", means] for column, means in columns.items()]
    return f"Columns of `{name}`:\n\n{_table(['column', 'meaning'], rows)}"


def answer_models() -> list[type[AnswerPart]]:
    """The models of all answers and of their parts, the header of every answer first.

    Those of plugins come with their questions.
    """
    all_questions()
    found: dict[type[AnswerPart], None] = {}
    waiting: list[type[AnswerPart]] = [AnswerPart]
    while waiting:
        derived = waiting.pop().__subclasses__()
        found |= dict.fromkeys(derived)
        waiting += derived
    of_tools = (model for model in found if model.__module__.startswith("webots_mcp."))
    return sorted(of_tools, key=lambda model: (model is not Answer, model.__name__))


def _is_own(model: type[AnswerPart], name: str) -> bool:
    return not any(name in getattr(base, "model_fields", {}) for base in model.__mro__[1:])


def _based_on(model: type[AnswerPart]) -> str:
    base = model.__mro__[1].__name__
    return f" Also has the fields of {base}." if base != AnswerPart.__name__ else ""


def _plain_type(field: Any) -> str:
    kind = field.annotation
    text = kind.__name__ if inspect.isclass(kind) and not hasattr(kind, "__args__") else str(kind)
    text = re.sub(r"\b(?:typing|webots_mcp\.answers\.models)\.", "", text)
    return f"`{text.removesuffix(' | None')}`"


def checks(_page: str = "") -> str:
    """Each check with what it needs."""
    rows = [[each.name, each.means, each.needs or "nothing"] for each in CHECKS]
    return "## The checks\n\n" + _table(["check", "when it warns and fails", "needs"], rows)


def events(_page: str = "") -> str:
    """Each kind of event: what it is, whether it lasts, and the checks that judge it."""
    rows = [
        [
            f"`{kind.name}`",
            kind.means or kind.name,
            "yes" if kind.lasts else "no",
            ", ".join(check.name for check in CHECKS if kind.name in check.kinds),
        ]
        for kind in KINDS
    ]
    return "## All kinds\n\n" + _table(["kind", "what it is", "has a duration", "checks"], rows)


def proven(_page: str = "") -> str:
    """Each check of `webots-mcp prove`: what it expects, and what works if that is wrong."""
    rows = [
        [f"`{name}`", *(check.__doc__ or "").rstrip(".").split("; otherwise ")]
        for name, check in PROVEN.items()
    ]
    rows += [[f"`{name}`", "not tried", why] for name, why in NOT_TRIED.items()]
    return "## The checks\n\n" + _table(["check", "expected", "otherwise"], rows)


def stand_in(_page: str = "") -> str:
    """The members of Webots' classes that the stand-in does not have, class by class."""
    import webots_mcp.standin

    assert webots_mcp.standin.__all__  # It puts its package `controller` on the path.
    import controller
    from controller.surface import MEMBERS, Lacking

    had = {each.__name__: each for each in controller.__all__}
    inherited = {name for name, each in vars(had["Robot"]).items() if isinstance(each, Lacking)}
    lines: list[str] = []
    for name in sorted(had):
        missing = {member for member, each in vars(had[name]).items() if isinstance(each, Lacking)}
        also = " (and those of `Robot`)" if name == "Supervisor" else ""
        names = sorted(missing - inherited if also else missing)
        lines += [f"- `{name}`{also}: {', '.join(f'`{each}`' for each in names) or 'none'}"]
    others = ", ".join(f"`{name}`" for name in sorted({*MEMBERS} - {*had}))
    return (
        "## Missing members\n\nOf the classes that the stand-in has:\n\n"
        + "\n".join(lines)
        + f"\n\nThese classes can be imported, and fail when used: {others}.\n"
    )


def meanings(_page: str = "") -> str:
    """What may be declared of a signal, and the words of names that need no declaration."""
    fields = [
        ["`quantity`", ", ".join(f"`{each}`" for each in QUANTITIES)],
        ["`role`", ", ".join(f"`{each}`" for each in ROLES)],
        ["`side`", ", ".join(f"`{each}`" for each in SIDES)],
        ["`unit`", "a text of up to 20 characters"],
        ["`target_of`, `same_as`", "the name of one other signal"],
        ["`low`, `high`", "finite numbers"],
    ]
    words = [[said, ", ".join(f"`{w}`" for w in ws)] for said, ws in understood_words().items()]
    forms = [[f"`{short}`", f"`{long}`"] for short, long in short_forms().items()]
    return "\n".join((
        "## What may be declared\n", _table(["field", "values"], fields),
        "## Words that are understood\n", _table(["meaning", "words and units"], words),
        "## Short forms\n", _table(["short form", "stands for"], forms),
    ))  # fmt: skip


_described = cache(described)


def commands(group: str | None = None) -> str:
    """Each command with its arguments, as `--help` has them.

    Args:
        group: Only the commands of this group of the help.
    """
    shown = {
        name: (
            each.text,
            [(f"`{typed}`", said) for typed, said in each.arguments.items()],
        )
        for name, each in _described().items()
        if group in (None, COMMANDS[name].group)
    }
    return "## Reference\n\n" + "\n".join(
        f"### {name}\n\n{as_markdown(text)}\n\n{_list(arguments)}"
        for name, (text, arguments) in sorted(shown.items())
    )


def tables(_page: str = "") -> str:
    """The tables and views of a new recording, with the comments that it carries."""
    memory = MemoryDatabase()
    with closing(connect(memory, "writer")) as connection:
        create_schema(connection)
        made = connection.execute(
            "SELECT type, name, sql FROM sqlite_master WHERE type IN ('table', 'view') "
            "AND name NOT LIKE 'sqlite%' AND name <> 'alembic_version' ORDER BY type, name"
        ).fetchall()
        columns = {name: connection.execute(f"PRAGMA table_info({name})").fetchall()
                   for _, name, _ in made}  # fmt: skip
    memory.close()
    parts = ["## Reference\n"]
    parts += [_relation(kind, name, sql, columns[name]) for kind, name, sql in made]
    return "\n".join(parts)


def _relation(kind: str, name: str, sql: str, columns: list[Any]) -> str:
    if kind == "view":
        said = _COMMENT.search(sql)
        names = ", ".join(f"`{column[1]}`" for column in columns)
        return f"### {name} (view)\n\n{said[1].strip() if said else ''}\n\nColumns: {names}.\n"
    rows = [[f"`{column[1]}`", column[2] or "any", _comment(sql, column[1])] for column in columns]
    return f"### {name}\n\n{_table(['column', 'type', 'meaning'], rows)}"


def _comment(sql: str, column: str) -> str:
    found = re.search(rf"(?m)[\s,(]{column} [A-Z][^,]*?/\*(.*?)\*/", sql)
    return found[1].strip() if found else ""


def interface(_page: str = "") -> str:
    """Directives that read the docstrings of what may be imported."""
    homes = ((webots_mcp, webots_mcp.__all__), (testing, testing.__all__))
    classes = [
        _class(f"{home.__name__}.{name}", getattr(home, name))
        for home, names in homes
        for name in sorted(names)
        if inspect.isclass(getattr(home, name))
    ]
    return "\n".join([*classes, "## Fixtures of pytest\n", *_fixtures()])


def _class(path: str, documented: type[Any]) -> str:
    """The fields of a named tuple are told by its docstring."""
    fields = ", ".join(getattr(documented, "_fields", ()))
    left_out = f"   :exclude-members: {fields}\n" if fields else ""
    directive = f".. autoclass:: {path}\n   :members:\n{left_out}"
    return f"## {documented.__name__}\n\n```{{eval-rst}}\n{directive}```\n"


def _fixtures() -> Iterator[str]:
    members = vars(pytest_plugin)
    for name, each in sorted(members.items()):
        if isinstance(each, type(members["webots_robot"])):
            yield f"### {name}\n\n{as_markdown(inspect.getdoc(each) or '')}\n"


def as_markdown(text: str) -> str:
    """A docstring: Markdown, but for brackets and stars; what is indented is to be copied."""
    return "\n\n".join(
        f"```sh\n{inspect.cleandoc(paragraph)}\n```"
        if paragraph.startswith(" ")
        else escaped(paragraph)
        for paragraph in text.split("\n\n")
    )


def escaped(text: str) -> str:
    """With what stands outside of backticks taken as it is."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([<>*\[\]])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def _table(columns: list[str], rows: list[list[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    cells = (
        [as_markdown(cell).replace("|", "\\|").replace("\n", " ") for cell in line]
        for line in lines
    )
    return "\n".join(f"| {' | '.join(line)} |" for line in cells) + "\n"


def _ignoring_page(make: Callable[[str], str], name: str, _page: str) -> str:
    return make(name)


ADDED: Final[dict[str, Callable[[str], str]]] = {
    "docs/index": navigation,
    "docs/check": checks,
    "docs/events": events,
    "docs/fields": fields,
    "docs/meanings": meanings,
    "docs/accuracy": lambda _page: subpages("accuracy"),
    "docs/tools": lambda _page: subpages("tools"),
    "docs/command-line": lambda _page: subpages("command-line"),
    "docs/database": tables,
    "docs/standin": stand_in,
    "docs/webots": proven,
    "docs/python": interface,
}
ADDED.update(
    {f"docs/tools/{page}": partial(_ignoring_page, tools, name) for page, name in HEADINGS.items()}
    | {
        f"docs/command-line/{page}": partial(_ignoring_page, commands, name)
        for page, name in COMMAND_GROUPS.items()
    }
)
