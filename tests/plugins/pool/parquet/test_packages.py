"""A package that is missing is named with what installs it."""

from __future__ import annotations

import sys

import pytest

from webots_mcp.errors import PoolError
from webots_mcp.plugins.pool.storage import package


@pytest.mark.parametrize(
    ("name", "installs"),
    [("pyarrow.parquet", r"'fsspec>=[\d.]+' 'pyarrow>=\d+'"), ("duckdb", "'duckdb'")],
)
def test_what_is_missing_is_named_with_what_installs_it(
    name: str, installs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name.partition(".")[0], None)
    monkeypatch.delitem(sys.modules, "pyarrow.parquet", raising=False)
    with pytest.raises(PoolError, match=f"-m pip install {installs}$"):
        package(name)
