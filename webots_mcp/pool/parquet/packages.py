"""Packages of the extra `parquet`, which have no types: what they give is `Any`."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from webots_mcp.errors import PoolError


def package(name: str) -> Any:
    """A module of a package of the extra.

    Raises:
        PoolError: It is not installed; the text names the extra.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise PoolError(
            f"a pool of Parquet files needs {name.partition('.')[0]}: "
            "pip install 'webots-mcp[parquet]'"
        ) from error
