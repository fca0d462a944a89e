"""Retention waits for the shipper, within a size; beyond it, it deletes and says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.recordings.runs import Recorded, states
from webots_mcp.cli import main
from webots_mcp.store.purge import Upkeep
from webots_mcp.store.retention import Limit, Retention
from webots_mcp.store.retention_plan import Shipped, plan, write_shipped

MB = 1_000_000
Say = Callable[..., str]


def keeping(retention: Retention, size_bytes: int) -> Retention:
    return replace(retention, unshipped=Limit(size_bytes=size_bytes))


def tell_shipped(filed: Recorded, address: str = "a pool", **last_ids: int) -> None:
    uuid = filed.connection.execute("SELECT uuid FROM recording").fetchone()[0]
    file = filed.folder / "webots.db"
    write_shipped(file, address, Shipped(uuid, last_ids, filed.wall_s + 1, filed.wall_s))


def test_without_the_limit_nothing_waits(filed: Recorded) -> None:
    filed.prune(states(rows=5))
    assert filed.count("state") == 5


def test_what_was_never_shipped_stays(filed: Recorded) -> None:
    filed.prune(keeping(states(rows=5), MB))
    assert filed.count("state") == 40


def test_what_is_shipped_goes_and_the_rest_stays(filed: Recorded) -> None:
    tell_shipped(filed, state=25)
    filed.prune(keeping(states(rows=5), MB))
    assert filed.rows() == {2: 15}


def test_of_several_pools_the_one_that_is_behind_counts(filed: Recorded) -> None:
    tell_shipped(filed, state=25)
    tell_shipped(filed, "another", state=10)
    filed.prune(keeping(states(rows=5), MB))
    assert filed.count("state") == 30


def test_a_pool_that_wants_no_states_does_not_hold_them(filed: Recorded) -> None:
    tell_shipped(filed, log=0)
    limits = replace(states(rows=5), log=Limit(rows=5))
    filed.prune(keeping(limits, MB))
    assert filed.count("state") == 5
    assert filed.count("log") == 20


def test_beyond_the_size_the_oldest_goes_all_the_same_and_the_plan_says_so(
    filed: Recorded,
) -> None:
    tell_shipped(filed, state=0)
    wanted = plan(filed.connection, keeping(states(rows=5), 1000), filed.wall_s)
    (lost,) = wanted.unshipped
    (kept,) = wanted.spared
    assert kept.size_bytes <= 1000
    assert (lost.table, lost.rows + kept.rows) == ("state", 35)
    filed.prune(keeping(states(rows=5), 1000))
    assert filed.count("state") == 5 + kept.rows
    assert min(filed.rows()) == 2


def test_a_run_is_not_forgotten_while_rows_of_it_wait(filed: Recorded) -> None:
    for _ in range(4):
        filed.add_run(20)
    forgetting = replace(states(rows=10), chunk=Limit(rows=10), outlive=2.0)
    filed.prune(keeping(forgetting, MB))
    assert (filed.count("run"), filed.count("state")) == (6, 120)
    tell_shipped(filed, state=999, log=999, event=999, image=999, kept_state=999)
    filed.prune(keeping(forgetting, MB))
    assert filed.count("run") < 6


def test_a_server_warns_once_when_it_deletes_what_was_not_shipped(
    filed: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    tell_shipped(filed, state=0)
    limits = keeping(states(rows=5), 1)
    upkeep = Upkeep(filed.folder, lambda _: limits, interval_s=0, budget_s=60)
    upkeep(filed.connection)
    filed.add_run(20)
    upkeep(filed.connection)
    assert capsys.readouterr().err.count("not shipped yet (state 35)") == 1


def test_the_limit_is_set_shown_and_taken_back_from_the_shell(
    filed: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--data-dir", str(filed.folder)]
    assert main(["retain", "--keep-until-shipped", "2GB", *where]) == 0
    main(["status", "--json", *where])
    assert '"until_shipped": "2.00 GB (set by retain' in capsys.readouterr().out
    assert main(["prune", "--keep-states", "5rows", "--dry-run", *where]) == 0
    assert "35 rows of state" in (told := capsys.readouterr().out)
    assert "not shipped yet" in told
    assert main(["retain", "--keep-until-shipped", "default", *where]) == 0
    main(["status", "--json", *where])
    assert "until_shipped" not in capsys.readouterr().out


@pytest.mark.parametrize("limit", ["all", "30d", "2GB,30d"])
def test_what_is_no_size_is_refused(
    filed: Recorded, capsys: pytest.CaptureFixture[str], limit: str
) -> None:
    where = ["--data-dir", str(filed.folder)]
    assert main(["retain", "--keep-until-shipped", limit, *where]) == 2
    assert "--keep-until-shipped 2GB" in capsys.readouterr().err
