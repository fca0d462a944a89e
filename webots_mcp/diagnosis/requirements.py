"""Which packages are missing: the bridge is installed without any. Standard library only."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata
from typing import Final

_NAME: Final = re.compile(r"[\w.-]+")
_OLD_PYTHON: Final = re.compile(r"""python_version < ['"]3\.(\d+)['"]""")


def missing_requirements() -> Iterator[str]:
    """Those of this package, without its extras, that are not installed."""
    try:
        requirements = metadata.requires("webots-mcp") or []
    except metadata.PackageNotFoundError:  # used without being installed
        return
    for requirement in requirements:
        if (
            "extra ==" not in requirement
            and _is_for_us(requirement)
            and not _is_installed(package_of(requirement))
        ):
            yield requirement


def package_of(requirement: str) -> str:
    """The package that a requirement names."""
    found = _NAME.match(requirement)
    return found.group() if found else requirement


def this_python() -> str:
    """This Python's path, as a shell takes it."""
    return f"'{sys.executable}'" if " " in sys.executable else sys.executable


def pip_line(requirements: Iterable[str]) -> str:
    """The line that installs them for this Python."""
    quoted = " ".join(f"'{requirement}'" for requirement in requirements)
    return f"{this_python()} -m pip install {quoted}"


def _is_for_us(requirement: str) -> bool:
    """Whether this Python is old enough to need it."""
    older_than = _OLD_PYTHON.search(requirement)
    return older_than is None or sys.version_info < (3, int(older_than[1]))


def _is_installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return False
    return True
