"""What somebody reads of a pool who knows nothing but the names of its files."""

from __future__ import annotations

from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

parquet: Any = import_module("pyarrow.parquet")  # it has no types


def globbed(folder: Path, name: str) -> list[dict[str, Any]]:
    """The rows of all files of a table."""
    files = sorted(folder.glob(f"recording=*/table={name}/**/*.parquet"))
    return [row for file in files for row in records(file)]


def records(file: Path | BytesIO) -> list[dict[str, Any]]:
    """The rows of one file."""
    return parquet.ParquetFile(file).read().to_pylist()
