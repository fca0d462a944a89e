"""The files in which MCP clients configure servers, and our entry in them."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import sys
import sysconfig
from collections import Counter
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

from webots_mcp.contract import PROJECT_FILE
from webots_mcp.errors import CommandRefusedError, InvalidInputError
from webots_mcp.extras.requirements import checkout, install_line, quoted
from webots_mcp.setup.file_change import FileChange, read

TOKEN_VARIABLE: Final = "WEBOTS_MCP_TOKEN"  # of clients that ask over HTTP
_BOM: Final = "\ufeff"
# Folders of environments that uv makes for one command and clears away with its cache.
_PASSING: Final = re.compile(r"(archive|builds|environments)-v\d+")
_STRING: Final = r'"(?:\\.|[^"\\\n])*"'
_COMMENT: Final = re.compile(rf"{_STRING}|(//[^\n]*|/\*.*?\*/)", re.DOTALL)
_TRAILING_COMMA: Final = re.compile(rf"{_STRING}|(,)(?=\s*[}}\]])")


class Client(NamedTuple):
    """An MCP client: its name, its file, and the member of it that holds the servers.

    Attributes:
        variable: How an environment variable is written in a header; None where HTTP is not known.
    """

    name: str
    file: Path
    servers: str = "mcpServers"
    variable: str | None = "${env:%s}"


def clients_of(project: Path) -> list[Client]:
    """Return the clients that read files in the folder of a project."""
    return [
        Client("Claude Code", project / ".mcp.json", variable="${%s}"),
        Client("Cursor", project / ".cursor" / "mcp.json"),
        Client("VS Code", project / ".vscode" / "mcp.json", "servers"),
    ]


def claude_desktop(platform: str = sys.platform) -> Client:
    """Claude Desktop, whose one file is the user's."""
    if platform == "win32":
        folder = Path(os.environ.get("APPDATA") or Path.home() / "AppData" / "Roaming")
    elif platform == "darwin":
        folder = Path.home() / "Library" / "Application Support"
    else:
        folder = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    file = folder / "Claude" / "claude_desktop_config.json"
    return Client("Claude Desktop", file, variable=None)


def server_command(data_dir: Path) -> list[str]:
    """Return a command that starts the server from anywhere, whatever PATH the client was given."""
    script = Path(sysconfig.get_path("scripts")) / "webots-mcp"
    if sys.platform == "win32":
        script = script.with_suffix(".exe")
    program = [str(script)] if script.is_file() else [sys.executable, "-m", "webots_mcp"]
    return [*program, "serve", "--data-dir", str(data_dir)]


def server_hindrance() -> str | None:
    """Return why clients could not start this server, now or some day; None where they can."""
    if importlib.util.find_spec("mcp") is None:
        return (
            f"the server cannot be started by {sys.executable}, which lacks the package mcp: "
            f"run {install_line([checkout()])}, and 'webots-mcp init' from there"
        )
    if not any(map(_PASSING.fullmatch, Path(sys.prefix).parts)):
        return None
    return (
        f"this webots-mcp runs from uv's cache ({sys.prefix}), which may be cleared: install it "
        f"by '{quoted(['uv', 'tool', 'install', checkout()])}' and run 'webots-mcp init' again"
    )


def plan_entry(client: Client, name: str, server: list[str] | str) -> tuple[FileChange, str | None]:
    """Return the change that makes a client know the server, and what there is to know about it.

    An entry of ours that can be started is left as it is, also where it differs: its options are
    the user's. One that cannot be started any more gets the command anew and keeps its options.
    The address of a server that runs replaces either; its token is left to a variable, as these
    files are in repositories.

    Raises:
        InvalidInputError: The file cannot be read as JSON, the name is taken, or the client asks
            no server over HTTP.
        OSError: It cannot be read.
    """
    before = read(client.file)
    wanted: dict[str, Any]
    if isinstance(server, list):
        wanted = {"command": server[0], "args": server[1:]}
    elif client.variable:
        token = client.variable % TOKEN_VARIABLE
        headers = {"Authorization": f"Bearer {token}"}
        wanted = {"type": "http", "url": server, "headers": headers}
    else:
        raise InvalidInputError(f"{client.name} reads no servers over HTTP from its file")
    try:
        text = before.decode("utf-8-sig") if before is not None else ""
        after, note = _with_entry(text if text.strip() else "{}\n", client.servers, name, wanted)
        bom = _BOM if before is not None and before.startswith(_BOM.encode()) else ""
        content = (bom + after).encode()
    except (InvalidInputError, UnicodeError) as error:
        raise InvalidInputError(f"{client.file} is left as it is: {error}") from error
    unchanged = before if before is not None and note else None
    return FileChange(client.file, before, unchanged or content), note


def _with_entry(
    text: str, servers: str, name: str, wanted: dict[str, Any]
) -> tuple[str, str | None]:
    document = object_in(text)
    there: dict[str, Any] = document.get(servers, {})
    if not isinstance(there, dict):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise InvalidInputError(f"{json.dumps(servers)} holds no object there")
    if name not in there:
        for other, entry in there.items():
            if entry == wanted:
                return text, f"it has this server by the name {other!r}"
        first: dict[str, Any] = {} if servers in document else {servers: {}}
        return _rewritten(text, {**first, **document, servers: {name: wanted, **there}}), None
    if not is_ours(there[name]):
        raise InvalidInputError(
            f"its server {name!r} is not webots-mcp; choose another name with --name"
        )
    entry = cast("dict[str, Any]", there[name])
    if all(entry.get(key) == value for key, value in wanted.items()):
        return text, None
    if "url" in wanted:
        return _rewritten(text, {**document, servers: {**there, name: wanted}}), None
    if can_be_started(entry):
        kept = entry.get("url") or " ".join(words_of(entry))
        return text, f"it has an entry {name!r} of its own, which is kept: {kept}"
    arguments: list[str] = wanted["args"]
    options = entry["args"][entry["args"].index("serve") + 1 :]
    if "--data-dir" in options or "--database" in options:
        arguments = arguments[: arguments.index("serve") + 1]
    mended = {**entry, "command": wanted["command"], "args": [*arguments, *options]}
    return _rewritten(text, {**document, servers: {**there, name: mended}}), None


def is_ours(entry: Any) -> bool:
    """Return whether an entry starts `webots-mcp serve`, or gives our token to a server."""
    if not isinstance(entry, dict):
        return False
    words = words_of(cast("dict[str, Any]", entry))
    if "url" in entry:
        return TOKEN_VARIABLE in json.dumps(entry)
    names = {re.split(r"[\\/]", word)[-1].removesuffix(".exe") for word in words}
    return "serve" in words[1:] and bool(names & {"webots-mcp", "webots_mcp"})


def words_of(entry: dict[str, Any]) -> list[str]:
    """Return the command line of an entry; empty where it has none."""
    command: object = entry.get("command")
    arguments: object = entry.get("args", [])
    if not isinstance(command, str) or not isinstance(arguments, list):
        return []
    return [command, *(str(each) for each in cast("list[object]", arguments))]


def can_be_started(entry: dict[str, Any]) -> bool:
    """Not by a name alone: a client that was started from the desktop has a poor PATH.

    Of `uvx` and other programs that install first only the program is searched for.
    """
    if "url" in entry:
        return True
    command: str = entry["command"]
    if Path(command).is_absolute():
        return Path(command).is_file()
    return command not in ("webots-mcp", "python", "python3") and bool(shutil.which(command))


def policy_file(project: Path) -> FileChange:
    """Return the project's file that allows what is harmless; an existing file stays unchanged."""
    file = project / PROJECT_FILE
    before = read(file)
    usual = Path(__file__).with_name("allowed.toml").read_bytes()
    return FileChange(file, before, usual if before is None else before)


def ignore_file(data_dir: Path) -> FileChange:
    """Return the file that keeps the recordings out of a Git repository; an existing file stays.

    Raises:
        CommandRefusedError: The data folder is a file.
    """
    if data_dir.exists() and not data_dir.is_dir():
        raise CommandRefusedError(f"{data_dir} is no folder: recordings go there; rename it")
    file = data_dir / ".gitignore"
    before = read(file)
    return FileChange(file, before, b"*\n" if before is None else before)


def object_in(text: str) -> dict[str, Any]:
    """Return the JSON object that a text holds, perhaps with comments and trailing commas.

    Raises:
        InvalidInputError: It is no such thing; the message names the line and the column.
    """
    plain = _blanked(_TRAILING_COMMA, _blanked(_COMMENT, text))
    try:
        value: object = json.loads(plain, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise InvalidInputError(
            f"line {error.lineno}, column {error.colno}: {error.msg}"
        ) from error
    except RecursionError as error:
        raise InvalidInputError("its values lie too deep in each other") from error
    if not isinstance(value, dict):
        raise InvalidInputError("it holds no JSON object at its top, which begins with {")
    return cast("dict[str, Any]", value)


def _rewritten(text: str, value: dict[str, Any]) -> str:
    """Return the text of another value, indented as before.

    Raises:
        InvalidInputError: The text has comments or trailing commas, which would be lost.
    """
    try:
        json.loads(text)
    except json.JSONDecodeError as error:
        raise InvalidInputError(
            f"what is no plain JSON in it would be lost (line {error.lineno}), as a comment; "
            f"change it by hand to hold {json.dumps(value)}"
        ) from error
    step = re.search(r"\n([ \t]+)", text)
    written = json.dumps(value, indent=step[1] if step else 2, ensure_ascii=False) + "\n"
    return written.replace("\n", "\r\n") if "\r\n" in text else written


def _blanked(pattern: re.Pattern[str], text: str) -> str:
    """Replace what the group matches by spaces, so that lines and columns stay."""

    def blank(found: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", found[0]) if found[1] else found[0]

    return pattern.sub(blank, text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    for name, count in Counter(name for name, _ in pairs).items():
        if count > 1:
            raise InvalidInputError(f"the name {json.dumps(name)} is there twice in one object")
    return members
