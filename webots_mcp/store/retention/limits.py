"""The limits of a database belong to it, not to who maintains it: set once, they hold for all.

`prune` and `retain` set what a person asks for. A server sets limits that are not set yet, or that
a server set which no longer runs; while another server runs, it reports the limits in force.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final, NamedTuple

from webots_mcp.errors import InvalidInputError
from webots_mcp.liveness import process_alive
from webots_mcp.store.retention.notation import NO_LIMIT, limit_text, option_of
from webots_mcp.store.retention.policy import DEFAULT, Limit, Retention
from webots_mcp.transactions import transaction

Asked = Mapping[str, "Limit | float | None"]
"""Limits by the names that they have in `Retention`; None is back to the default."""

SERVE: Final = "serve"
KINDS: Final = ("state", "kept_state", "chunk", "log", "event", "image", "unshipped")
_KIND_OF: Final = {**{kind: kind for kind in KINDS}, "outlive": "run"}
_NAME_OF: Final = {kind: name for name, kind in _KIND_OF.items()}
_SHOWN: Final = {"unshipped": "until_shipped"}  # only where it was set
_READ: Final = (
    "SELECT kind, size_bytes, row_count, age_s, outlive_factor, set_by, set_wall_time_s "
    "FROM retention_limit"
)
_SET: Final = (
    "INSERT OR REPLACE INTO retention_limit "
    "(kind, size_bytes, row_count, age_s, outlive_factor, set_by, set_wall_time_s) "
    "VALUES (?, ?, ?, ?, ?, ?, ?)"
)
_RESET: Final = "DELETE FROM retention_limit WHERE kind = ?"
_SERVER: Final = (
    "SELECT CAST(holder AS BLOB) FROM lease WHERE name = 'maintainer' AND holder LIKE 'server %' "
    "AND typeof(until_wall_time_s) IN ('real', 'integer') AND until_wall_time_s > ?"
)


class Setting(NamedTuple):
    """A limit that was set, and when."""

    value: Limit | float
    set_by: str
    set_wall_time_s: float


def read_settings(connection: sqlite3.Connection) -> dict[str, Setting]:
    """What was set, by the names that it has in `Retention`; of the others the defaults hold.

    Raises:
        InvalidInputError: The table holds something that is not a limit.
    """
    settings: dict[str, Setting] = {}
    for kind, size_bytes, rows, age_s, factor, set_by, set_s in connection.execute(_READ):
        try:
            name = _NAME_OF[kind]
            if name == "outlive":
                value = replace(DEFAULT, outlive=factor).outlive
            else:
                of_kind = getattr(DEFAULT, name)
                value = replace(of_kind, size_bytes=size_bytes, rows=rows, age_s=age_s)
        except (KeyError, TypeError, InvalidInputError) as error:
            raise InvalidInputError(
                f"the row {kind!r} of the table retention_limit is not a limit ({error}): set it "
                "again with 'webots-mcp retain'"
            ) from error
        settings[name] = Setting(value, set_by, set_s)
    return settings


def in_force(connection: sqlite3.Connection, asked: Asked | None = None) -> Retention:
    """The limits of a database; with `asked` as they would be after `set_limits`."""
    values: dict[str, Any] = {
        name: setting.value for name, setting in read_settings(connection).items()
    }
    for name, value in (asked or {}).items():
        values[name] = getattr(DEFAULT, name) if value is None else value
    return replace(DEFAULT, **values)


def set_limits(connection: sqlite3.Connection, asked: Asked, set_by: str) -> None:
    """Put these limits in force, whichever process maintains the database."""
    if not asked:
        return
    now_s = time.time()
    with transaction(connection):
        for name, value in asked.items():
            kind = _KIND_OF[name]
            if value is None:
                connection.execute(_RESET, (kind,))
            elif isinstance(value, Limit):
                limit = (value.size_bytes, value.rows, value.age_s, None)
                connection.execute(_SET, (kind, *limit, set_by, now_s))
            else:
                connection.execute(_SET, (kind, None, None, None, value, set_by, now_s))


def ask_at_start(connection: sqlite3.Connection, asked: Asked) -> list[str]:
    """Set what a starting server may set; returns for each limit that it may not what holds."""
    if not _another_server(connection):
        settings = read_settings(connection)
        mine = {
            name: value
            for name, value in asked.items()
            if name not in settings or settings[name].set_by == SERVE
        }
        set_limits(connection, _changed(mine, settings), SERVE)
    return unheeded(connection, asked)


def ask_where_unset(connection: sqlite3.Connection, asked: Asked) -> None:
    """Set limits that are not set: of a database created after the server started."""
    settings = read_settings(connection)
    if new := {name: value for name, value in asked.items() if name not in settings}:
        set_limits(connection, new, SERVE)


def unheeded(connection: sqlite3.Connection, asked: Asked) -> list[str]:
    """What was asked for and does not hold: what does, who set it, and how to change it."""
    settings = read_settings(connection)
    found: list[str] = []
    for name, value in asked.items():
        setting = settings.get(name)
        if setting is None or value is None or _text(setting.value) == _text(value):
            continue
        option = option_of(_KIND_OF[name])
        found.append(
            f"{option} {_text(value)} is not in force: the database keeps {_said(setting)}; "
            f"'webots-mcp retain {option} ...' changes it"
        )
    return found


def described(connection: sqlite3.Connection) -> dict[str, str]:
    """Each limit in force as a person reads it, with who set it and when."""
    settings, retention = read_settings(connection), in_force(connection)
    return {
        _SHOWN.get(kind, f"{kind}s"): _said(settings[name])
        if name in settings
        else f"{_text(getattr(retention, name))} (default)"
        for name, kind in _KIND_OF.items()
        if kind not in _SHOWN or name in settings
    }


def _changed(asked: Asked, settings: Mapping[str, Setting]) -> Asked:
    return {
        name: value
        for name, value in asked.items()
        if name not in settings or value is None or _text(settings[name].value) != _text(value)
    }


def _said(setting: Setting) -> str:
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(setting.set_wall_time_s))
    return f"{_text(setting.value)} (set by {setting.set_by}, {when})"


def _text(value: Limit | float) -> str:
    if isinstance(value, Limit):
        return limit_text(value)
    return f"{value:g} times as long as states" if value else NO_LIMIT


def _another_server(connection: sqlite3.Connection) -> bool:
    """Whether a server that runs maintains the database; one that was killed holds its lease on."""
    now_s = time.time()
    holders: Iterable[tuple[bytes]] = connection.execute(_SERVER, (now_s,)).fetchall()
    pids = [pid for (holder,) in holders for pid in holder.split()[1:2]]
    return any(pid.isdigit() and _lives(int(pid), now_s) for pid in pids)


def _lives(pid: int, now_s: float) -> bool:
    return pid != os.getpid() and process_alive(pid, None, now_s)
