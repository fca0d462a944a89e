"""Packages that need not be there, and have no types: what they give is `Any`."""

from __future__ import annotations

from importlib import import_module
from typing import Any, Final

from webots_mcp.errors import PoolError

_EXTRA: Final = ("pyarrow", "fsspec")
_NEEDS: Final = {"duckdb": "a SELECT over a pool of Parquet files"}


def package(name: str) -> Any:
    """A module of a package of the extra `parquet`, or of DuckDB.

    Raises:
        PoolError: It is not installed; the text says what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        whose = name.partition(".")[0]
        what = "webots-mcp[parquet]" if whose in _EXTRA else whose
        raise PoolError(
            f"{_NEEDS.get(whose, 'a pool of Parquet files')} needs {whose}: pip install '{what}'"
        ) from error
