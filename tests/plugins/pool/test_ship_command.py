"""`webots-mcp ship`: what it refuses, and with which sentence."""

from __future__ import annotations

import json

import pytest

from tests.plugins.pool.conftest import Shipped
from tests.plugins.pool.lab import POSTGRES
from tests.plugins.pool.rows import pooled
from tests.postgres import Server
from webots_mcp.cli import main


def test_two_pools_at_once_are_refused(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    two = ["--to", "/srv/one", "--to", "/srv/two"]
    assert main(["ship", "--data-dir", str(shipped.folder), *two]) == 2
    assert "one command ships to one pool" in capsys.readouterr().err


def test_a_password_in_the_url_is_refused_and_printed_nowhere(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    url = "postgresql://me:hunter2@db.lab/pool"
    assert main(["ship", "--data-dir", str(shipped.folder), "--to", url]) == 2
    said = capsys.readouterr()
    assert "PGPASSWORD" in said.err
    assert "hunter2" not in said.err + said.out


def test_a_pause_without_anything_to_wait_for_is_refused(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ["ship", "--data-dir", str(shipped.folder), "--to", "/srv/pool", "--every", "5"]
    assert main(asked) == 2
    assert "--every applies only to --follow" in capsys.readouterr().err


def test_programs_read_in_one_object_what_was_sent_or_why_not(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped.add_run(7)
    url = str(shipped.folder.parent / "files")
    line = ["ship", "--data-dir", str(shipped.folder), "--full", "--json", "--to"]
    assert main([*line, url]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["pool"], told["complete"], told["rows"]["state"]) == (url, True, 7)
    assert main([*line, "postgresql://127.0.0.1:1/pool"]) == 2
    assert json.loads(capsys.readouterr().out).keys() == {"error"}


@pytest.mark.slow
def test_a_recording_is_shipped_to_postgresql_as_it_is(
    shipped: Shipped, postgres: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped.add_run(1200)
    pool = postgres.new_database()
    line = ["ship", "--data-dir", str(shipped.folder), "--to", postgres.url(pool), "--full"]
    assert main(line) == 0
    assert "state 1200" in capsys.readouterr().out
    assert pooled(postgres.url(pool), shipped.uuid) == shipped.rows()
    assert main(line) == 0
    assert "already has everything" in capsys.readouterr().out


def test_a_server_that_is_not_there_is_said(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["ship", "--data-dir", str(shipped.folder), "--to", "postgresql://127.0.0.1:1/pool"]
    assert main(line) == 2
    assert "127.0.0.1:1/pool" in capsys.readouterr().err


@pytest.mark.slow
def test_a_server_that_only_reads_is_said_and_nothing_is_half_done(
    shipped: Shipped, postgres: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped.add_run()
    pool = postgres.new_database()
    postgres.execute("postgres", f"ALTER DATABASE {pool} SET default_transaction_read_only = on")
    line = ["ship", "--data-dir", str(shipped.folder), "--to", postgres.url(pool)]
    assert main(line) == 2
    said = capsys.readouterr()
    assert "read-only" in said.err
    assert said.out == ""


@pytest.mark.parametrize("kind", [POSTGRES, "parquet"])
def test_values_that_a_pool_cannot_hold_are_said(
    shipped: Shipped,
    kind: str,
    request: pytest.FixtureRequest,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_id = shipped.add_run()
    shipped.connection.execute(
        "INSERT INTO log (run_id, sim_time_s, wall_time_s, level, source, message) "
        "VALUES (?, 1, 1.7e9, 'info', 'controller', x'ff'), (?, 1, 1.7e9, x'ff', 'controller', '')",
        (run_id, run_id),
    )
    url = str(shipped.folder.parent / "files")
    if kind == "postgres":
        server: Server = request.getfixturevalue("postgres")
        url = server.url(server.new_database())
    assert main(["ship", "--data-dir", str(shipped.folder), "--to", url]) == 0
    said = "replaced by the nearest ones: log.level 1, log.message 1"
    assert said in capsys.readouterr().out
