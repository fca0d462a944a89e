"""Who may ask over HTTP: the token by which a program proves it, and the host that it asks.

There is one token for each user, in a file.

It is not in the data folder, which people copy and send. Whoever checks a request reads the file
anew, so that a token that was replaced is refused at once.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
import stat
import tempfile
from pathlib import Path
from typing import Final

from webots_mcp.database.files import full_path, make_folder
from webots_mcp.errors import CommandRefusedError

LOOPBACK: Final = ("127.0.0.1", "localhost", "[::1]")  # as a browser writes this computer
_SHORTEST: Final = 20  # characters


def token_file() -> Path:
    """Return where the token of this user is."""
    return full_path("~/.webots-mcp/token")


def access_token() -> str:
    """Return the token; it is made where there is none yet.

    Raises:
        CommandRefusedError: Other users can read the file, or there is no token in it.
        OSError: It can be neither read nor made.
    """
    file = token_file()
    if not file.exists():
        return new_token()
    found = file.stat()
    again = "'webots-mcp token --new' makes another"
    if os.name != "nt" and (stat.S_IMODE(found.st_mode) & 0o077 or found.st_uid != os.geteuid()):
        raise CommandRefusedError(f"other users may read or change {file}: {again}")
    token = file.read_text("ascii", "replace").strip()
    if len(token) < _SHORTEST or not token.isascii() or token.split() != [token]:
        raise CommandRefusedError(f"{file} holds no token of {_SHORTEST} characters: {again}")
    return token


def new_token() -> str:
    """Draw a token in place of the one that is there.

    Raises:
        OSError: It cannot be written.
    """
    file = token_file()
    make_folder(file.parent)
    handle, aside = tempfile.mkstemp(dir=file.parent, prefix="token.")  # its owner's alone
    try:
        with open(handle, "w", encoding="ascii") as written:  # noqa: PTH123
            written.write(f"{secrets.token_urlsafe(32)}\n")
        Path(aside).replace(file)
    finally:
        Path(aside).unlink(missing_ok=True)
    return access_token()


def is_admitted(authorization: str) -> bool:
    """Return whether a header holds the token, in a time that does not depend on the header.

    Raises:
        CommandRefusedError: There is no valid token, so that nobody is admitted.
    """
    scheme, _, given = authorization.partition(" ")
    token = access_token()
    is_it = hmac.compare_digest(given.strip().encode("utf-8", "replace"), token.encode())
    return is_it and scheme.lower() == "bearer"


def named_host(header: str) -> str | None:
    """Return the host that a Host header names, in lower case and without its port.

    None if it is anything else than a host, or a host and a port: `127.0.0.1:80@evil` is neither.
    """
    found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[0-9A-Za-z._-]+)(?::[0-9]{1,5})?", header)
    return found[1].lower() if found else None


def page_key() -> str:
    """Return what stands for the token in an address, which browsers keep and show: made from it.

    Raises:
        CommandRefusedError: There is no valid token.
    """
    return hmac.new(access_token().encode(), b"webots-mcp view", hashlib.sha256).hexdigest()[:32]
