"""Define how much of a recording is kept: the limits of each kind of row, and their spelling."""

from __future__ import annotations

import math
import re
import sqlite3
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, NamedTuple

from webots_mcp.database.transactions import transaction
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.run_rows import fetch_run

# Retention leaves runs alone that a person named, described or marked. Trials are labelled by the
# hundred without a person's judgement, but their scores stay.
KEPT: Final = (
    "(keep <> 0 OR coalesce(note, '') <> '' "
    "OR (coalesce(label, '') <> '' AND label NOT GLOB 'trial [0-9]* of set [0-9]*: *'))"
)
SERVE: Final = "serve"
KINDS: Final = ("state", "kept_state", "chunk", "log", "event", "image")
_KIND_OF: Final = {**{kind: kind for kind in KINDS}, "outlive": "run"}
_NAME_OF: Final = {kind: name for name, kind in _KIND_OF.items()}
_BYTES: Final = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12}
_SECONDS: Final = {"s": 1, "min": 60, "h": 3600, "d": 86_400, "w": 604_800}
NO_LIMIT: Final = "all"  # condition of a run that is kept


@dataclass(frozen=True)
class Limit:
    """How much of one kind is kept. None means no limit. The oldest is deleted first.

    Whole row groups or blocks of rows are deleted. The newest one stays even if it exceeds the
    limit alone, unless the limit is 0.

    Attributes:
        size_bytes: Size on the disk, with indexes and what is free on the pages; for pictures the
            size of their files.
        rows: Number of rows; for chunks the number of states they stand for.
        age_s: Seconds of wall time since they were written.
        spared_rows: Number of the newest rows, over all runs, that age alone does not delete, so
            that runs of abandoned work do not all vanish. Size and rows always hold.
    """

    size_bytes: int | None = None
    rows: int | None = None
    age_s: float | None = None
    spared_rows: int = 10_000

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not 0 <= value < math.inf:
                raise InvalidInputError(f"{field.name}={value} must be a finite number, 0 or more.")

    @property
    def limits(self) -> bool:
        """Whether it states any limit."""
        return (self.size_bytes, self.rows, self.age_s) != (None, None, None)

    def is_exceeded(
        self, *, size_bytes: float, rows: float, age_s: float = 0, times: float = 1
    ) -> bool:
        """Return whether a value exceeds N times its limit."""
        found = ((size_bytes, self.size_bytes), (rows, self.rows), (age_s, self.age_s))
        return any(limit is not None and value > times * limit for value, limit in found)


@dataclass(frozen=True)
class Retention:
    """The limits of each kind of row.

    They hold for the whole database, over all robots: rows are deleted in the order in which they
    were recorded, whatever their run. Runs that a person labelled (trials do not count), described
    or marked lose nothing and do not count.

    Attributes:
        state: State rows. They are deleted only after their values were put into chunks.
        chunk: The values of each signal, compressed, in groups of about 1,024 states. A group is
            deleted only after its states; answers then report that time as missing.
        log: Log lines.
        event: Events. Their age also holds for finished commands.
        image: Pictures, with their files.
        outlive: When the rest of a run is deleted: once this many times the limits of `chunk` and
            `state` were recorded after it. Or once it ended this many times their age ago, and at
            least the number of states that an age spares were recorded since. Its commands are
            deleted with the last run of that time. 0 keeps runs for ever.
        kept_state: Rows of full-rate segments: those that the throttle dropped, and those that were
            deleted from `state`. A segment that loses a row is removed.
    """

    state: Limit = Limit(size_bytes=1_000_000_000, spared_rows=50_000)
    chunk: Limit = Limit(size_bytes=1_000_000_000)
    log: Limit = Limit(size_bytes=100_000_000)
    event: Limit = Limit(size_bytes=100_000_000)
    image: Limit = Limit(size_bytes=1_000_000_000, spared_rows=50)
    outlive: float = 10.0
    kept_state: Limit = Limit(size_bytes=100_000_000)

    def __post_init__(self) -> None:
        if not (self.outlive == 0 or 1 <= self.outlive < math.inf):
            raise InvalidInputError(
                f"outlive={self.outlive} must be 1 or more, or 0 to keep forever."
            )


DEFAULT: Final = Retention()


def mark_kept(connection: sqlite3.Connection, run_ids: Sequence[int], *, keep: bool = True) -> None:
    """Mark runs to be kept, or no longer; either all of them or, on an error, none.

    Raises:
        UnknownRunError: A run does not exist.
    """
    with transaction(connection):
        for run_id in run_ids:
            fetch_run(connection, run_id)
        connection.executemany(
            "UPDATE run SET keep = ? WHERE id = ?", [(int(keep), run_id) for run_id in run_ids]
        )


# The limits belong to the database, not to the process that maintains it: they are set once for
# all. `prune` and `retain` set what a person wants. A server sets limits that no person has set,
# and reports the limits in force.


Asked = Mapping[str, "Limit | float | None"]
"""Limits by the names that they have in `Retention`; None is back to the default."""


class StoredLimit(NamedTuple):
    """A limit that was set, and when."""

    value: Limit | float
    set_by: str
    set_wall_time_s: float


def read_settings(connection: sqlite3.Connection) -> dict[str, StoredLimit]:
    """Return what was set, by its name in `Retention`; defaults apply to the others.

    Raises:
        InvalidInputError: The table holds something that is not a limit.
    """
    settings: dict[str, StoredLimit] = {}
    for kind, size_bytes, rows, age_s, factor, set_by, set_s in connection.execute(
        "SELECT kind, size_bytes, row_count, age_s, outlive_factor, set_by, set_wall_time_s "
        "FROM retention_limit"
    ):
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
                "again with 'webots-mcp retention'"
            ) from error
        settings[name] = StoredLimit(value, set_by, set_s)
    return settings


def in_force(connection: sqlite3.Connection, asked: Asked | None = None) -> Retention:
    """Return the limits of a database, or with `asked` those that `set_limits` would lead to."""
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
    query = (
        "INSERT OR REPLACE INTO retention_limit "
        "(kind, size_bytes, row_count, age_s, outlive_factor, set_by, set_wall_time_s) "
        "VALUES (?, ?, ?, ?, ?, ?, ?)"
    )
    with transaction(connection):
        for name, value in asked.items():
            kind = _KIND_OF[name]
            if value is None:
                connection.execute("DELETE FROM retention_limit WHERE kind = ?", (kind,))
            elif isinstance(value, Limit):
                limit = (value.size_bytes, value.rows, value.age_s, None)
                connection.execute(query, (kind, *limit, set_by, now_s))
            else:
                connection.execute(query, (kind, None, None, None, value, set_by, now_s))


def ask(connection: sqlite3.Connection, asked: Asked) -> list[str]:
    """Set the limits that no person has set. Return what applies instead of each other limit."""
    settings = read_settings(connection)
    mine = {
        name: value
        for name, value in asked.items()
        if name not in settings or settings[name].set_by == SERVE
    }
    set_limits(connection, mine, SERVE)
    return unheeded(connection, asked)


def unheeded(connection: sqlite3.Connection, asked: Asked) -> list[str]:
    """Return which requested limits do not apply, what applies, who set it and how to change it."""
    settings = read_settings(connection)
    found: list[str] = []
    for name, value in asked.items():
        setting = settings.get(name)
        if setting is None or value is None or _text(setting.value) == _text(value):
            continue
        option = option_of(_KIND_OF[name])
        found.append(
            f"{option} {_text(value)} is not in force: the database keeps {_said(setting)}; "
            f"'webots-mcp retention {option} ...' changes it"
        )
    return found


def described(connection: sqlite3.Connection) -> dict[str, str]:
    """Return each limit in force as text, with who set it and when."""
    settings, retention = read_settings(connection), in_force(connection)
    return {
        f"{kind}s": _said(settings[name])
        if name in settings
        else f"{_text(getattr(retention, name))} (default)"
        for name, kind in _KIND_OF.items()
    }


def _said(setting: StoredLimit) -> str:
    when = time.strftime("%Y-%m-%d %H:%M", time.localtime(setting.set_wall_time_s))
    return f"{_text(setting.value)} (set by {setting.set_by}, {when})"


def _text(value: Limit | float) -> str:
    if isinstance(value, Limit):
        return limit_text(value)
    return f"{value:g} times as long as chunks" if value else NO_LIMIT


# Spelling of limits: `500MB,30d`, `100000rows`, `all`.


def option_of(kind: str) -> str:
    """Return the command-line option that limits a kind of row."""
    return "--keep-stretches" if kind == "kept_state" else f"--keep-{kind}s"


def parse_limit(text: str, default: Limit) -> Limit:
    """Parse a limit from its parts, separated by commas; omitted parts are unlimited.

    Args:
        text: Sizes (kB, MB, GB), ages (min, h, d, w) and rows; or `all`, without any limit.
        default: The limit that spares a running run by default.

    Raises:
        InvalidInputError: A part is unknown or repeated.
    """
    limit: dict[str, Any] = {"size_bytes": None, "rows": None, "age_s": None}
    for part in [] if text.strip().lower() == NO_LIMIT else text.split(","):
        name, value = _parse_part(part.strip(), text)
        if limit[name] is not None:
            raise InvalidInputError(
                f"{text!r} limits the same thing twice. Give one limit of each kind."
            )
        limit[name] = value
    return replace(default, **limit)


def _parse_part(part: str, text: str) -> tuple[str, float]:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([a-z]+)", part, flags=re.IGNORECASE)
    if found is not None:
        number, unit = float(found[1]), found[2].lower()
        if unit in _BYTES:
            return "size_bytes", round(number * _BYTES[unit])
        if unit in _SECONDS:
            return "age_s", number * _SECONDS[unit]
        if unit in {"row": 1, "rows": 1}:
            return "rows", round(number)
    raise InvalidInputError(
        f"{part!r} in {text!r} is not a limit. Write a size (500MB), an age "
        "(30d), a number of rows "
        f"(100000rows), several of them separated by commas, or {NO_LIMIT} to keep everything."
    )


def limit_text(limit: Limit) -> str:
    """Return a limit in the form that `parse_limit` reads; a size is rounded."""
    parts = [size_text(limit.size_bytes)] if limit.size_bytes is not None else []
    parts += [f"{limit.age_s:g}s"] if limit.age_s is not None else []
    parts += [f"{limit.rows}rows"] if limit.rows is not None else []
    return ",".join(parts) or NO_LIMIT


def size_text(size_bytes: float) -> str:
    """Return a size in the units that `parse_limit` reads."""
    for unit in ("B", "kB", "MB"):
        if size_bytes < 1000:
            return f"{size_bytes:.0f} {unit}" if unit == "B" else f"{size_bytes:.1f} {unit}"
        size_bytes /= 1000
    return f"{size_bytes:.2f} GB"
