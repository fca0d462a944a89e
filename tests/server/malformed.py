"""A value of a wrong kind in a row, as other programs may leave it."""

from __future__ import annotations

import sqlite3
from typing import Any, Final, NamedTuple

NOT_UTF8: Final = "CAST(x'7b22ff41227d' AS TEXT)"


class Damage(NamedTuple):
    """One value of a wrong kind in the newest row of a table."""

    table: str
    column: str
    value: Any

    def apply(self, connection: sqlite3.Connection) -> None:
        where = f"rowid = (SELECT max(rowid) FROM {self.table})"
        new, values = ("?", (self.value,)) if self.value is not NOT_UTF8 else (NOT_UTF8, ())
        connection.execute("PRAGMA foreign_keys=OFF")
        sql = f"UPDATE {self.table} SET {self.column} = {new} WHERE {where}"
        assert connection.execute(sql, values).rowcount > 0, f"{self.table} has no row"

    def __str__(self) -> str:
        return f"{self.table}.{self.column} = {self.value!r:.40}"
