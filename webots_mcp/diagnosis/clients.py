"""Whether the files in which MCP clients look for servers name this one, so that it can start."""

from __future__ import annotations

import shutil
from itertools import pairwise
from typing import Any, Final, cast

from webots_mcp.diagnosis.finding import Finding, Subject, worst
from webots_mcp.errors import InvalidInputError
from webots_mcp.setup.client_entries import (
    Client,
    can_be_started,
    claude_desktop,
    clients_of,
    is_ours,
    words_of,
)
from webots_mcp.setup.file_changes import CommentedJSON

_PLACES: Final = ("--data-dir", "--database")
_INIT: Final = "run 'webots-mcp init' in the project"


def clients(subject: Subject) -> Finding:
    """Each file that is there, and whether its server can start on this recording."""
    known = [*clients_of(subject.project), claude_desktop()]
    there = [client for client in known if client.file.exists()]
    findings = [found for client in there for found in _look(subject, client)]
    if findings:
        return worst(findings)
    names = ", ".join(client.name for client in known)
    seen = f"no file of {names} for {subject.project} names webots-mcp"
    return Finding("warning", seen, f"{_INIT}; other clients have files of their own")


def _look(subject: Subject, client: Client) -> list[Finding]:
    """What a file says of our server: nothing where it names only others."""
    try:
        text = client.file.read_text("utf-8-sig")
        servers = CommentedJSON(text.strip() or "{}").value.get(client.servers)
    except (OSError, UnicodeDecodeError, InvalidInputError) as error:
        seen = f"{client.file} ({client.name}) cannot be read: {error}"
        return [Finding("wrong", seen, f"mend that file: {client.name} cannot read it either")]
    entries = cast("dict[str, Any]", servers) if isinstance(servers, dict) else {}
    return [
        _entry(subject, f"{client.name}, server {name!r}", entry)
        for name, entry in entries.items()
        if is_ours(entry)
    ]


def _entry(subject: Subject, name: str, entry: dict[str, Any]) -> Finding:
    command, *arguments = words_of(entry)
    if shutil.which(command) is None:
        return Finding("wrong", f"{name}: there is no program {command!r}", _INIT)
    if (other := _other_place(subject, arguments)) is not None:
        seen = f"{name} serves {other}, which is not what is looked at here"
        return Finding("warning", seen, "name the folder in which the controllers record")
    if not can_be_started(entry):
        seen = f"{name}: {command!r} is found by the PATH alone, which programs with windows lack"
        return Finding("ok", seen)
    return Finding("ok", f"{name} starts {command}")


def _other_place(subject: Subject, arguments: list[str]) -> str | None:
    """The recording that the arguments name, if it is another one."""
    words = [part for word in arguments for part in word.split("=", 1)]
    for option, value in pairwise(words):
        if option in _PLACES and "$" not in value:
            ours = subject.recording.data_dir if option == "--data-dir" else subject.file
            same = ours is not None and (subject.project / value).resolve() == ours.resolve()
            return None if same else value
    return None
