"""Whether the files in which MCP clients look for servers name this one, so that it can start."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.diagnosis.finding import Finding, Subject, worst

# In a project's folder, with the member that lists the servers.
_FILES: Final = ((".mcp.json", "mcpServers"),)
_MAIN_OPTIONS: Final = ("--data-dir", "--database")
_ADD: Final = (
    "write .mcp.json as in examples/.mcp.json, or run 'claude mcp add webots -- webots-mcp serve "
    "--data-dir ...'; a client whose file is elsewhere needs none here"
)


def clients(subject: Subject) -> Finding:
    """Each file that is there, and whether its server can start on this recording."""
    findings = [
        _file(subject, subject.project / name, member)
        for name, member in _FILES
        if (subject.project / name).exists()
    ]
    if findings:
        return worst(findings)
    return Finding("warning", f"no .mcp.json is in {subject.project}", _ADD)


def _file(subject: Subject, file: Path, member: str) -> Finding:
    name = str(file.relative_to(subject.project))
    try:
        servers = _servers_in(file, member)
    except (OSError, ValueError) as error:
        return Finding("wrong", f"{name} cannot be read: {error}", f"mend {file}")
    ours = [(key, entry) for key, entry in servers.items() if _is_ours(entry)]
    if not ours:
        return Finding("warning", f"{name} names no webots-mcp", _ADD)
    return worst([_entry(subject, f"{name}, {key!r}", entry) for key, entry in ours])


def _servers_in(file: Path, member: str) -> dict[str, dict[str, Any]]:
    """Raises ValueError where the file is no JSON, or has another form."""
    data: Any = json.loads(file.read_text("utf-8-sig"))
    servers: Any = cast("dict[str, Any]", data).get(member, {}) if isinstance(data, dict) else None
    if not isinstance(servers, dict):
        raise ValueError(f"it is no object with an object {member!r}")
    entries = cast("dict[str, Any]", servers)
    return {key: entry for key, entry in entries.items() if isinstance(entry, dict)}


def _words(entry: dict[str, Any]) -> list[str]:
    arguments: Any = entry.get("args")
    rest = cast("list[Any]", arguments) if isinstance(arguments, list) else []
    return [str(word) for word in (entry.get("command", ""), *rest)]


def _is_ours(entry: dict[str, Any]) -> bool:
    return any("webots-mcp" in word or "webots_mcp" in word for word in _words(entry)[:4])


def _entry(subject: Subject, name: str, entry: dict[str, Any]) -> Finding:
    command, *arguments = _words(entry)
    if shutil.which(command, path=_path_of(entry)) is None:
        return Finding(
            "wrong",
            f"{name}: there is no program {command!r}",
            f"write a full path: {shutil.which('webots-mcp') or 'that of Python, -m webots_mcp'}",
        )
    if "serve" not in arguments:
        return Finding("wrong", f"{name} does not say 'serve'", "add 'serve' to its args")
    if (named := _other_place(subject, arguments)) is not None:
        return Finding(
            "warning",
            f"{name} serves {named}, which is not what is looked at here",
            "name the folder in which the controllers record",
        )
    return Finding("ok", f"{name} starts {command}")


def _path_of(entry: dict[str, Any]) -> str | None:
    environment: Any = entry.get("env")
    if not isinstance(environment, dict):
        return None
    path: Any = cast("dict[str, Any]", environment).get("PATH")
    return path if isinstance(path, str) else None


def _other_place(subject: Subject, arguments: list[str]) -> str | None:
    """The recording that the arguments name, if it is another one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        ours = subject.recording.data_dir if option == "--data-dir" else subject.file
        if option in _MAIN_OPTIONS and not value.startswith("$"):
            same = ours is not None and (subject.project / value).resolve() == ours.resolve()
            return None if same else value
    return None
