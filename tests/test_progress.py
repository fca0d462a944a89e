"""A run of tests prints a line when a file ends, names failures at once, and skips at the end."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

CHECKOUT = Path(__file__).parents[1]
SOME = """
import pytest

@pytest.mark.parametrize("n", range(3))
def test_numbers(n):
    if n: pytest.skip(reason="too large")

def test_wrong():
    assert False

@pytest.mark.xfail(reason="not yet")
def test_later():
    assert False
"""


@pytest.mark.parametrize("workers", [(), ("-n", "2")], ids=["one process", "two workers"])
def test_files_failures_and_skips_are_named(workers: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "test_some.py").write_text(SOME)
    (tmp_path / "test_none_wrong.py").write_text("def test_right(): pass")
    plugins = ("-p", "tests.progress", "-p", "no:cacheprovider")
    line = [sys.executable, "-m", "pytest", "-q", *plugins, *workers, "--tb=no", str(tmp_path)]
    run = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, check=False)

    assert run.returncode == 1, run.stderr
    said = run.stdout
    assert re.search(r"(?m)^ *\d+ %  \d of 6  0:\d\d  FAILED .*::test_wrong$", said), said
    assert re.search(r"of 6 .*test_some.py  1 failed, 1 passed, 3 skipped in ", said), said
    assert re.search(r"of 6 .*test_none_wrong.py  1 passed in ", said), said
    assert "100 %  6 of 6" in said
    assert re.search(r"(?m)^too large:\n  .*test_some.py::test_numbers \(2 times\)$", said), said
    assert re.search(r"(?m)^expected to fail: not yet:\n  .*::test_later$", said), said
