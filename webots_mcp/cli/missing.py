"""What to install where a command finds a package missing: the bridge is installed without any."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib import metadata
from typing import Final

_NAME: Final = re.compile(r"[\w.-]+")
_OLD_PYTHON: Final = re.compile(r"""python_version < ['"]3\.(\d+)['"]""")


def explain_missing(error: ModuleNotFoundError) -> str:
    """Which packages are missing, and the line that installs them."""
    python = f"'{sys.executable}'" if " " in sys.executable else sys.executable
    wanted = list(_missing_requirements())
    if not wanted:
        return (
            f"the Python package {error.name!r} is missing: install webots-mcp with what it "
            f"depends on, from its checkout by '{python} -m pip install .'"
        )
    names = ", ".join(_name(requirement) for requirement in wanted)
    line = " ".join(f"'{requirement}'" for requirement in wanted)
    return (
        f"this command needs packages that a bridge does without, and they are missing: {names}. "
        f"Install them with\n\n    {python} -m pip install {line}\n"
    )


def _missing_requirements() -> Iterator[str]:
    """Those of this package, without its extras, that are not installed."""
    try:
        requirements = metadata.requires("webots-mcp") or []
    except metadata.PackageNotFoundError:  # used without being installed
        return
    for requirement in requirements:
        if (
            "extra ==" not in requirement
            and _is_for_us(requirement)
            and not _is_installed(_name(requirement))
        ):
            yield requirement


def _is_for_us(requirement: str) -> bool:
    """Whether this Python is old enough to need it."""
    older_than = _OLD_PYTHON.search(requirement)
    return older_than is None or sys.version_info < (3, int(older_than[1]))


def _name(requirement: str) -> str:
    found = _NAME.match(requirement)
    return found.group() if found else requirement


def _is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True
