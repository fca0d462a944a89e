"""What this Python brings along."""

from __future__ import annotations

import pytest

from webots_mcp.setup.doctor.machine_checks import judge_sqlite


@pytest.mark.parametrize(
    ("version", "has_it"),
    [
        ((3, 40, 1), True), ((3, 44, 5), True), ((3, 44, 6), False), ((3, 45, 0), True),
        ((3, 50, 6), True), ((3, 50, 7), False), ((3, 51, 2), True), ((3, 51, 3), False),
        ((3, 53, 0), False),
    ],
)  # fmt: skip
def test_the_wal_reset_bug_is_known_by_version(version: tuple[int, ...], has_it: bool) -> None:
    found = judge_sqlite(version)
    assert found.verdict == "ok"
    assert ("WAL-reset bug" in found.seen) is has_it


def test_an_sqlite_that_is_too_old_is_wrong() -> None:
    found = judge_sqlite((3, 37, 2))
    assert (found.verdict, "3.38" in found.seen) == ("wrong", True)
    assert found.fix
