"""Limits belong to the database: who sets them, who keeps to them, who says that others hold."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.recordings.runs import Recorded
from webots_mcp.cli import main
from webots_mcp.errors import InvalidInputError
from webots_mcp.store.purge import Upkeep
from webots_mcp.store.retention_limits import (
    DEFAULT,
    Limit,
    ask,
    in_force,
    set_limits,
)

Say = Callable[..., str]
MB = 1_000_000


@pytest.fixture
def say(filed: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Say:
    def said(*line: str) -> str:
        assert main([*line, "--data-dir", str(tmp_path)]) == 0
        return capsys.readouterr().out

    return said


def test_retain_sets_a_limit_and_deletes_nothing(say: Say, filed: Recorded) -> None:
    assert "Limits are set" in say("retention", "--keep-states", "30rows", "--keep-runs", "all")
    assert filed.rows() == {1: 20, 2: 20}
    assert in_force(filed.connection).state.rows == 30
    status = " ".join(say("status", "--storage").split())
    assert "states 30rows (set by retain, " in status
    assert "runs all (set by retain, " in status
    assert "logs 100.0 MB" in status.split("defaults")[1]
    shown = json.loads(say("status", "--json"))
    kept = shown["retention"]
    assert kept["kept"]["states"].startswith("30rows (set by retain")
    assert kept["file_bytes"] > kept["free_in_file_bytes"] >= 0


def test_who_maintains_keeps_to_what_was_set(say: Say, filed: Recorded) -> None:
    upkeep = Upkeep(filed.folder, interval_s=0, budget_s=60)
    upkeep(filed.connection)
    assert filed.rows() == {1: 20, 2: 20}
    say("retain", "--keep-states", "30rows")
    upkeep(filed.connection)
    assert filed.rows() == {2: 20}


def test_prune_sets_what_it_is_given_and_a_dry_run_only_tries_it(say: Say, filed: Recorded) -> None:
    say("prune", "--dry-run", "--keep-states", "5rows")
    assert in_force(filed.connection) == DEFAULT
    say("prune", "--keep-states", "30rows")
    assert filed.rows() == {2: 20}, "a limit holds for whole row groups"
    filed.publish(100.0, {"x": 1})
    say("prune")
    assert filed.rows() == {2: 21}
    say("retain", "--keep-states", "default")
    assert in_force(filed.connection) == DEFAULT


def test_retain_without_runs_and_limits_says_what_it_takes(
    filed: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["retain", "--data-dir", str(tmp_path)]) == 2
    assert "--keep-states 20GB" in capsys.readouterr().err


def test_a_server_sets_what_nobody_has_set_and_what_an_earlier_server_had(
    filed: Recorded,
) -> None:
    db = filed.connection
    for size in (60 * MB, 5 * MB):
        assert ask(db, {"state": Limit(size_bytes=size)}) == []
        assert in_force(db).state.size_bytes == size
    set_limits(db, {"state": Limit(size_bytes=80 * MB), "outlive": 3.0}, "retain")
    (states,) = ask(db, {"state": Limit(size_bytes=5 * MB), "outlive": 3.0})
    assert states.startswith(
        "--keep-states 5.0 MB is not in force: the database keeps 80.0 MB (set by retain, "
    )
    assert states.endswith("'webots-mcp retention --keep-states ...' changes it")
    assert in_force(db).state.size_bytes == 80 * MB


@pytest.mark.slow
def test_a_server_says_that_what_a_person_has_set_holds(filed: Recorded, tmp_path: Path) -> None:
    set_limits(filed.connection, {"state": Limit(size_bytes=60 * MB)}, "retain")
    line = [sys.executable, "-m", "webots_mcp", "serve", "--data-dir", str(tmp_path)]
    server = subprocess.run(
        [*line, "--keep-states", "5MB"], stdin=subprocess.DEVNULL, capture_output=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert b"--keep-states 5.0 MB is not in force: the database keeps 60.0 MB" in server.stderr
    assert in_force(filed.connection).state.size_bytes == 60 * MB


@pytest.mark.parametrize("wrong", ["'state', -1", "'state', 'many'", "'soup', 1"])
def test_a_row_that_is_no_limit_is_named(filed: Recorded, wrong: str) -> None:
    filed.connection.execute(
        "INSERT INTO retention_limit (kind, size_bytes, set_by, set_wall_time_s) "
        f"VALUES ({wrong}, 'hand', 0)"
    )
    with pytest.raises(InvalidInputError, match="retention_limit is not a limit"):
        in_force(filed.connection)
