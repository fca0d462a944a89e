"""Packages that need not be there, and have no types: what they give is `Any`."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

from webots_mcp.errors import PoolError
from webots_mcp.requirements import explain_extra, install_line

_EXTRA: Final = ("pyarrow", "fsspec")


def package(name: str) -> Any:
    """A module of a package of the extra `parquet`, or of DuckDB.

    Raises:
        PoolError: It is not installed; the text says what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        whose = name.partition(".")[0]
        if whose in _EXTRA:
            raise PoolError(explain_extra("a pool of Parquet files", "parquet")) from error
        asked = f"a SELECT over a pool of Parquet files needs {whose}"
        raise PoolError(f"{asked}: {install_line([whose])}") from error
