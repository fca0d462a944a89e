"""The recipes of docs/pool.md: each is run as it stands, beside a pool."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.pool.parquet.conftest import RECORDINGS, Many

FILE = Path(__file__).parents[3] / "docs" / "pool.md"


def answer(section: str, many: Many) -> str:
    """What the code of a section prints."""
    body = re.search(rf"(?ms)^### {section}$(.*?)(?=^##|\Z)", FILE.read_text("utf-8"))
    assert body is not None, f"there is no section {section}"
    (code,) = re.findall(r"(?ms)^```python\n(.*?)^```$", body[1])
    line = [sys.executable, "-c", code]
    done = subprocess.run(
        line, cwd=many.pool.parent, capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_recipe_for_duckdb_counts_the_states_of_each_robot(many: Many) -> None:
    pytest.importorskip("duckdb", reason="duckdb is not installed")
    counts = re.findall(r"rover_(\d) *│ *(\d+)", answer("DuckDB", many))
    expected = {n: sum(200 + 3 * k for k in range(n, RECORDINGS, 10)) for n in range(10)}
    assert {int(name): int(count) for name, count in counts} == expected


def test_the_recipe_for_polars_counts_the_warnings_of_the_runs(many: Many) -> None:
    pytest.importorskip("polars", reason="polars is not installed")
    assert re.search(rf"lab +┆ {RECORDINGS}\b", answer("Polars", many))
