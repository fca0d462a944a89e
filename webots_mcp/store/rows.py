"""Rows as dataclasses: the fields of one are the columns of its table, in any order."""

from __future__ import annotations

from dataclasses import fields
from typing import Any


def columns_of(row: type[Any]) -> str:
    """What to select so that a row is the arguments of this dataclass."""
    return ", ".join(field.name for field in fields(row))
