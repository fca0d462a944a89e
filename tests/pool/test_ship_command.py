"""`webots-mcp ship`: what it refuses, and with which sentence."""

from __future__ import annotations

import pytest

from tests.pool.conftest import Shipped
from webots_mcp.cli import main


def test_two_pools_at_once_are_refused(
    shipped: Shipped, capsys: pytest.CaptureFixture[str]
) -> None:
    two = ["--to", "/srv/one", "--to", "/srv/two"]
    assert main(["ship", "--data-dir", str(shipped.folder), *two]) == 2
    assert "one call ships to one pool" in capsys.readouterr().err


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
    assert "--every is for --follow" in capsys.readouterr().err
