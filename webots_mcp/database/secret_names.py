"""Names whose values are never shown, because they look like secrets.

A project adds patterns in its `webots-mcp.toml`, where it can also switch inspection off:

    [inspect]
    secret = ["*_pin", "owner"]
    enabled = true
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.contract import INSPECT_VARIABLE, PROJECT_FILE
from webots_mcp.database.location import find_project
from webots_mcp.errors import InvalidInputError

TABLE: Final = "inspect"
LEFT_OUT: Final = "(left out: its name looks secret)"
# Parts of names, in either case: `api_key`, `accessToken`, `DB_PASSWORD`; not `author` or `passed`.
_SECRET: Final = (
    r"(?i)passw|passphrase|passcode|pwd|secret|token|credential|cookie|auth(?!or)"
    r"|(?:api|access|private|encryption|signing|ssh)[-_ ]?key"
)
_KEYS: Final = ("secret", "enabled")
_OFF: Final = ("0", "false", "no", "off")
_ENDED: Final = "inspection is switched off by {}"


@dataclass(frozen=True)
class RememberedNames:
    """How many names have a remembered answer.

    Attributes:
        names: Names that are remembered.
        characters: Length up to which a name is remembered.
    """

    names: int = 2_000
    characters: int = 200


_REMEMBERED: Final = RememberedNames()


class SecretNames:
    """Decides whose values are shown.

    Args:
        patterns: Of more names, in which `*` stands for any text.
    """

    def __init__(self, patterns: tuple[str, ...] = ()) -> None:
        self._patterns = tuple(each.lower() for each in patterns)
        self._known: dict[str, bool] = {}  # most names come again

    def has(self, name: str) -> bool:
        """Return whether a name looks secret."""
        known = self._known.get(name)
        if known is None:
            known = self._judge(name)
            if len(self._known) < _REMEMBERED.names and len(name) <= _REMEMBERED.characters:
                self._known[name] = known
        return known

    def _judge(self, name: str) -> bool:
        if re.search(_SECRET, name) is not None:
            return True
        lowered = name.lower()
        return any(fnmatchcase(lowered, each) for each in self._patterns)


def read_secret_names(data_dir: Path) -> SecretNames:
    """Read what the project of a data folder adds.

    Raises:
        InvalidInputError: Inspection is switched off, or the file's table is invalid: nothing may
            be shown that the project wants to hide.
    """
    if os.environ.get(INSPECT_VARIABLE, "").strip().lower() in _OFF:
        raise InvalidInputError(_ENDED.format(f"{INSPECT_VARIABLE}=0"))
    for folder in (find_project(data_dir), data_dir):
        file = folder and folder / PROJECT_FILE
        if file and file.is_file():
            return SecretNames(_patterns_in(file))
    return SecretNames()


def check_table(file: Path, table: object) -> tuple[str, ...]:
    """Return the patterns of the table `[inspect]`.

    Raises:
        InvalidInputError: A key is unknown, or a value is of another type.
    """
    where = f"{file}: [{TABLE}]"
    if not isinstance(table, dict):
        raise InvalidInputError(f"{where} must be a table")
    said = cast("dict[str, Any]", table)
    if unknown := [key for key in said if key not in _KEYS]:
        raise InvalidInputError(f"{where} holds {' and '.join(_KEYS)}, not {unknown[0]!r}")
    patterns = cast("list[Any]", said.get("secret", []))
    if type(patterns) is not list or not all(type(each) is str for each in patterns):
        raise InvalidInputError(f"{where}: secret must be a list of texts")
    if type(said.get("enabled", True)) is not bool:
        raise InvalidInputError(f"{where}: enabled must be true or false")
    return tuple(patterns)


def _patterns_in(file: Path) -> tuple[str, ...]:
    text = file.read_text("utf-8")
    if re.search(rf"(?m)^\s*\[?\s*{TABLE}\b", text) is None:
        return ()
    try:
        content: dict[str, Any] = _toml().loads(text)
    except Exception as error:
        raise InvalidInputError(f"{file} cannot be read: {error}") from error
    patterns = check_table(file, content.get(TABLE, {}))
    if not content.get(TABLE, {}).get("enabled", True):
        raise InvalidInputError(_ENDED.format(f"{file}"))
    return patterns


def _toml() -> Any:
    """Return Python's TOML reader, before 3.11 the package that this one is installed with."""
    try:
        return import_module("tomllib")
    except ImportError:
        return import_module("tomli")
