"""Which packages webots-mcp needs, which of them are missing, and the line that installs them.

A package of that name is on no index yet, and pip would install whatever is registered first. So no
advice names it there: it names the packages that are missing, or where this one was installed from.
Standard library only: a controller's Python has nothing but the bridge.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlparse
from urllib.request import url2pathname


def missing_requirements(extra: str | None = None) -> list[str]:
    """Return what is not installed of the packages of the server, or of an extra."""
    return [each for each in _requirements(extra) if not _is_installed(package_of(each))]


def explain_extra(what: str, extra: str) -> str:
    """That something needs the packages of an extra, and the line that installs them.

    Args:
        what: The subject of the sentence.
        extra: Its name in pyproject.toml.
    """
    wanted = missing_requirements(extra) or _requirements(extra)
    if not wanted:  # this package is used without being installed
        return f"{what} needs packages that are missing: {install_line([f'{checkout()}[{extra}]'])}"
    names = " and ".join(map(package_of, wanted))
    return f"{what} needs {names}: {install_line(wanted)}"


def install_line(requirements: Iterable[str]) -> str:
    """Return the line that installs packages for this Python; uv's environments have no pip."""
    quote = '"' if sys.platform == "win32" else "'"  # each: > would write to a file
    wanted = " ".join(f"{quote}{each}{quote}" for each in requirements)
    if find_spec("pip") is None:
        return f"uv pip install --python {quoted([sys.executable])} {wanted}"
    return f"{quoted([sys.executable])} -m pip install {wanted}"


def package_of(requirement: str) -> str:
    """Return the package that a requirement names."""
    found = re.match(r"[\w.-]+", requirement)
    return found.group() if found else requirement


def checkout() -> str:
    """Return where this package was installed from, as pip takes it.

    The word CHECKOUT, for a person to replace, where that is not known or not there any more.
    """
    above = Path(__file__).parents[2]
    if (above / "pyproject.toml").is_file():
        return str(above)
    try:
        text = metadata.distribution("webots-mcp").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        text = None
    origin = json.loads(text or "{}")
    url = str(origin.get("url", ""))
    if "vcs_info" in origin:
        return f"{origin['vcs_info']['vcs']}+{url}@{origin['vcs_info']['commit_id']}"
    place = url2pathname(unquote(urlparse(url).path)) if url.startswith("file:") else ""
    return place if place and Path(place).exists() else "CHECKOUT"


def quoted(command: list[str], platform: str = sys.platform) -> str:
    """Return the command as it is typed into the system's shell; on Windows cmd or PowerShell."""
    if platform != "win32":
        return shlex.join(command)
    line = subprocess.list2cmdline(command)
    return f"& {line}   (in cmd without the &)" if line.startswith('"') else line


def _requirements(extra: str | None) -> list[str]:
    try:
        requirements = metadata.requires("webots-mcp") or []
    except metadata.PackageNotFoundError:  # used without being installed
        return []
    wanted = [each for each in requirements if _extra_of(each) == extra and _is_for_us(each)]
    return [each.partition(";")[0].strip() for each in wanted]


def _extra_of(requirement: str) -> str | None:
    found = re.search(r"""extra == ['"]([\w.-]+)['"]""", requirement)
    return found[1] if found else None


def _is_for_us(requirement: str) -> bool:
    """Return whether this Python is as old, or as new, as those that need it."""
    found = re.search(r"""python_version (<|>=) ['"]3\.(\d+)['"]""", requirement)
    is_older = found is not None and sys.version_info < (3, int(found[2]))
    return found is None or is_older == (found[1] == "<")


def _is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True
