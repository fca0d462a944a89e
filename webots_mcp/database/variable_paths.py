"""Paths to variables of a controller as they are written, such as `self.pid.integral`."""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from webots_mcp.contract import WATCHED
from webots_mcp.database.secret_names import SecretNames
from webots_mcp.errors import InvalidInputError

MOST_CHARACTERS: Final = 200
_NAME: Final = r"\s*([^\W\d]\w*)"
_PART: Final = r"\s*(?:\.\s*([^\W\d]\w*)|\[\s*(-?\d{1,9}|'[^']*'|\"[^\"]*\")\s*\])"
_EXAMPLES: Final = "such as self.pid.integral, path[3] or table['x']"


class AttributePath(NamedTuple):
    """A path that was parsed.

    Attributes:
        text: As it was given, without spaces at its ends.
        root: The variable that it begins with.
        steps: An attribute's name (True), or a key or an index (False).
    """

    text: str
    root: str
    steps: tuple[tuple[bool, str | int], ...]

    @property
    def signal(self) -> str:
        """Its name as a signal, where an item or a key follows a dot, as in all signals."""
        return ".".join([WATCHED, self.root, *(str(step) for _, step in self.steps)])


def parse_path(text: object, secrets: SecretNames) -> AttributePath:
    """Parse a path.

    Raises:
        InvalidInputError: It is no path, too long, or a name in it looks secret.
    """
    if not isinstance(text, str) or len(text) > MOST_CHARACTERS:
        raise InvalidInputError(
            f"path must be a text of at most {MOST_CHARACTERS} characters, {_EXAMPLES}"
        )
    text = text.strip()
    root = re.match(_NAME, text)
    if root is None:
        raise InvalidInputError(f"{text!r} does not begin with the name of a variable; {_EXAMPLES}")
    at, steps = root.end(), list[tuple[bool, str | int]]()
    while at < len(text):
        part = re.compile(_PART).match(text, at)
        if part is None:
            raise InvalidInputError(
                f"{text!r} is no path from its character {at + 1} on: it is made of names, .name, "
                f"[3] and ['key'], {_EXAMPLES}"
            )
        name, key = part.groups()
        if name:
            steps.append((True, name))
        else:
            steps.append((False, key[1:-1] if key[0] in "'\"" else int(key)))
        at = part.end()
    for name in (root.group(1), *(str(step) for _, step in steps)):
        if secrets.has(name):
            raise InvalidInputError(f"{name!r} looks secret, so its value is not shown")
    return AttributePath(text, root.group(1), tuple(steps))
