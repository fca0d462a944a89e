"""Where the server listens over HTTP, and which hosts a request may be addressed to."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mcp.server.transport_security import TransportSecuritySettings

from webots_mcp.errors import InvalidInputError
from webots_mcp.server.access_token import LOOPBACK


class Endpoint(NamedTuple):
    """Where a server listens.

    Attributes:
        allowed: Host names, in addition to those of loopback, that requests may be addressed to.
        certificate, key: PEM files for TLS; both or neither.
    """

    host: str
    port: int
    allowed: Sequence[str] = ()
    certificate: Path | None = None
    key: Path | None = None

    @property
    def scheme(self) -> str:
        """The scheme of its address."""
        return "https" if self.certificate else "http"

    def require_safe(self) -> None:
        """Check that nobody on the network can read the token, or what it opens.

        Raises:
            InvalidInputError: If somebody could, or a file of TLS is missing.
        """
        if (self.certificate is None) != (self.key is None):
            raise InvalidInputError("--tls-cert and --tls-key belong together: give both")
        if _is_loopback(self.host) or (self.allowed and self.certificate):
            return
        raise InvalidInputError(
            f"{self.host} can be reached from the network: that takes --tls-cert FILE and "
            "--tls-key FILE, and --allow-host NAME for each name that clients use. Without them "
            f"serve on this computer alone (--http {self.port}), and let another computer come "
            f"through a tunnel: ssh -N -L {self.port}:127.0.0.1:{self.port} USER@THIS_COMPUTER"
        )


def endpoint_of(
    text: str, allowed: Sequence[str] = (), certificate: Path | None = None, key: Path | None = None
) -> Endpoint:
    """Return the endpoint that `[HOST:]PORT` names; without a host, the port of 127.0.0.1.

    Raises:
        InvalidInputError: If the text names none, or one that is not safe.
    """
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal() and int(port) < 2**16):
        raise InvalidInputError(f"--http {text!r} is not [HOST:]PORT, such as 8000")
    place = Endpoint(host.strip("[]") or LOOPBACK[0], int(port), allowed, certificate, key)
    place.require_safe()
    return place


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def allowed_hosts(place: Endpoint) -> tuple[str, ...]:
    """Return the hosts that requests may be addressed to."""
    own = (place.host,) if _is_loopback(place.host) else ()  # such as 127.0.0.2
    return (*LOOPBACK, *own, *place.allowed)


def transport_security(place: Endpoint) -> TransportSecuritySettings:
    """Return the settings of the SDK: the allowed hosts, and origins of the same hosts."""
    names = (*allowed_hosts(place), *map(str.lower, place.allowed))  # as clients send it
    hosts = [spelled for name in names for spelled in (name, f"{name}:*")]
    origins = [f"{place.scheme}://{host}" for host in hosts]
    return TransportSecuritySettings(allowed_hosts=hosts, allowed_origins=origins)
