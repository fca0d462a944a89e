"""Shipping to a pool of Parquet files: each row once, whatever happens between."""

from __future__ import annotations

import errno
import io
import json
import os
import sqlite3
import stat
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests import unprivileged
from tests.plugins.pool.parquet import bucket
from tests.plugins.pool.parquet.bucket import Bucket, KilledError
from tests.plugins.pool.parquet.files import globbed, parquet, records
from tests.plugins.pool.rows import (
    OTHER_UUID,
    UUID,
    batch,
    logs,
    pooled,
    pooled_rows,
    recorded,
    run_row,
    ship,
    shipping,
    uuid_of,
)
from webots_mcp.errors import InvalidInputError, PoolBusyError, PoolError, PoolUnavailableError
from webots_mcp.plugins.pool.parquet_pool import PART_BYTES, ParquetPool
from webots_mcp.plugins.pool.pool_interface import Batch, PoolRow, SQLValue, table
from webots_mcp.plugins.pool.shipping_lease import LEASE_S

DAY_S = 86_400.0
MIDNIGHT_S = 19_700 * DAY_S

HOLDER = """
import os, sys
from webots_mcp.plugins.pool.pool_contents import open_pool
with open_pool(sys.argv[1], ships=True) as pool:
    with pool.shipment(sys.argv[2]):
        print("ships", flush=True)
        sys.stdin.read()
        os._exit(9)
"""


def ids(rows: Sequence[PoolRow]) -> list[SQLValue]:
    return [row[0] for row in rows]


@pytest.mark.slow
def test_an_object_store_has_each_table_row_by_row(reader: sqlite3.Connection) -> None:
    url = bucket.empty()
    ship(reader, url)
    assert pooled(url, uuid_of(reader)) == recorded(reader)


def write_all(url: str, steps: Sequence[list[Batch]]) -> None:
    """As a shipper does: it begins behind the progress that the pool tells."""
    with shipping(url) as shipment:
        for number, step in enumerate(steps, 1):
            if number > shipment.progress().get("step", 0):
                shipment.write(step, {"step": number})


STEPS = [
    [batch("run", run_row(1, 3)), logs(1, 2, 3, wall_time_s=MIDNIGHT_S - 3)],
    [batch("run", run_row(1, 5)), logs(4, 5, wall_time_s=MIDNIGHT_S - 3)],
    [batch("run", run_row(1, 6), run_row(2, 0)), logs(6, wall_time_s=MIDNIGHT_S - 3)],
]


def globbed_ids(name: str) -> list[int]:
    contents = [content for path, content in Bucket.store.items() if f"/table={name}/" in path]
    return [row["id"] for content in contents for row in records(io.BytesIO(content.getvalue()))]


@pytest.mark.slow
def test_killed_at_any_put_a_shipper_goes_on_and_each_row_is_there_once() -> None:
    write_all(bucket.empty(), STEPS)
    puts = Bucket.puts
    assert puts > 12
    for after in range(puts):
        url = bucket.empty()
        with bucket.failing(after, KilledError()), pytest.raises(KilledError):
            write_all(url, STEPS)
        assert not [n for n in Counter(globbed_ids("log")).values() if n > 1]
        Bucket.store.pop(f"/pool/robots/recording={UUID}/_lease", None)  # it has run out
        write_all(url, STEPS)
        assert (
            ids(pooled_rows(url, UUID, "log")) == sorted(globbed_ids("log")) == [1, 2, 3, 4, 5, 6]
        )
        at = table("run").columns.index("row_count")
        assert [row[at] for row in pooled_rows(url, UUID, "run")] == [6, 0]


def test_rows_that_never_counted_and_were_purged_meanwhile_are_not_there_twice_or_half() -> None:
    url = bucket.empty()
    write_all(url, STEPS[:1])
    puts = Bucket.puts
    with bucket.failing(3, KilledError()), pytest.raises(KilledError):
        write_all(url, [STEPS[0], [logs(4, 5, 6), batch("run", run_row(1, 6))]])
    assert Bucket.puts > puts
    Bucket.store.pop(f"/pool/robots/recording={UUID}/_lease", None)
    assert ids(pooled_rows(url, UUID, "log")) == [1, 2, 3]  # the others do not count yet
    write_all(url, [STEPS[0], [logs(6, 7)]])
    assert ids(pooled_rows(url, UUID, "log")) == sorted(globbed_ids("log")) == [1, 2, 3, 6, 7]


def test_who_reads_all_files_while_somebody_ships_sees_no_row_twice(tmp_path: Path) -> None:
    seen: list[Counter[int]] = []
    over = threading.Event()

    def read() -> None:
        while not over.is_set():
            seen.append(Counter(row["id"] for row in globbed(tmp_path, "log")))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        with shipping(tmp_path) as shipment:
            for first in range(1, 400, 10):
                shipment.write([logs(*range(first, first + 10))], {})
    finally:
        over.set()
        reader.join()
    assert any(counts for counts in seen)
    assert all(set(counts.values()) <= {1} for counts in seen)


def test_small_batches_are_gathered_in_one_file_a_day(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        for row_id in range(1, 31):
            shipment.write([logs(row_id, wall_time_s=MIDNIGHT_S - 20)], {})
    names = [file.parent.name for file in tmp_path.rglob("table=log/*/*.parquet")]
    assert sorted(names) == ["day=2023-12-08", "day=2023-12-09"]
    assert ids(pooled_rows(str(tmp_path), UUID, "log")) == list(range(1, 31))


@pytest.mark.slow
def test_a_large_file_is_over_and_another_begins(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        for row_id in range(1, 8):
            noise = os.urandom(PART_BYTES // 2).hex()
            shipment.write([logs(row_id, message=noise)], {})
    names = sorted(file.name for file in tmp_path.rglob("table=log/*/*.parquet"))
    assert names == [f"part-{number:06}.parquet" for number in (1, 2, 3, 4)]
    assert ids(pooled_rows(str(tmp_path), UUID, "log")) == list(range(1, 8))


@pytest.mark.slow
def test_rows_may_come_that_lie_before_others_and_each_is_there_once(tmp_path: Path) -> None:
    kept = {*range(1, 900, 9), 500, 501, 505}
    with shipping(tmp_path) as shipment:
        shipment.write([logs(*sorted(kept), message="kept")], {})
        for first in range(1, 1000, 100):
            noise = os.urandom(PART_BYTES // 2).hex() if first % 300 == 1 else ""
            *others, last = sorted({*range(first, first + 100)} - kept)
            shipment.write([logs(*others), logs(last, message=noise)], {})
    assert len(list(tmp_path.rglob("table=log/*/*.parquet"))) > 1
    assert ids(pooled_rows(str(tmp_path), UUID, "log")) == list(range(1, 1001))
    rows = globbed(tmp_path, "log")
    assert Counter(row["id"] for row in rows) == Counter(range(1, 1001))
    assert {row["id"] for row in rows if row["message"].startswith("kept")} == kept


def test_a_row_without_a_time_is_on_no_day(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        shipment.write(
            [batch("log", {"id": 1, "wall_time_s": None}), logs(2, wall_time_s=1e300)], {}
        )
    assert [file.parent.name for file in tmp_path.rglob("table=log/*/*.parquet")] == [
        "day=__HIVE_DEFAULT_PARTITION__"
    ]


def test_a_column_without_values_has_its_type_and_each_its_unit(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        shipment.write([logs(1)], {})
    (file,) = tmp_path.rglob("table=log/*/*.parquet")
    schema: Any = parquet.read_schema(file)
    assert str(schema.field("logger").type) == "string"
    assert schema.field("sim_time_s").metadata == {b"unit": b"s"}
    assert b"name of the Python logger" in schema.field("logger").metadata[b"comment"]


def test_a_second_shipper_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    line = [sys.executable, "-c", HOLDER, str(tmp_path), UUID]
    first = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    assert first.stdout.readline() == "ships\n"
    with pytest.raises(PoolBusyError, match=f"process {first.pid} on .* ships this recording"):
        write_all(str(tmp_path), STEPS)
    lease = tmp_path / f"recording={UUID}" / "_lease"
    lease.write_text(json.dumps(json.loads(lease.read_text()) | {"until_wall_time_s": 1.0}))
    with pytest.raises(PoolBusyError):  # it is slow, and lives
        write_all(str(tmp_path), STEPS)
    with shipping(tmp_path, OTHER_UUID):  # of another recording it is free
        pass
    first.kill()
    first.communicate()
    write_all(str(tmp_path), STEPS)
    assert len(globbed(tmp_path, "log")) == 6


def test_a_shipper_of_another_host_is_waited_for_until_its_lease_is_over(tmp_path: Path) -> None:
    write_all(str(tmp_path), STEPS[:1])
    lease = tmp_path / f"recording={UUID}" / "_lease"
    other = {"host": "elsewhere", "pid": 1, "process": "x", "token": "x"}
    for left_s in (30.0, LEASE_S + 20):  # its clock is ahead
        lease.write_text(json.dumps(other | {"until_wall_time_s": time.time() + left_s}))
        with pytest.raises(PoolBusyError, match="process 1 on elsewhere ships this recording"):
            write_all(str(tmp_path), STEPS)
    lease.write_text(json.dumps(other | {"until_wall_time_s": time.time() - 1}))
    write_all(str(tmp_path), STEPS)
    assert not lease.exists()


def test_who_lost_the_lease_writes_nothing_that_counts(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        shipment.write([logs(1)], {"log": 1})
        lease = tmp_path / f"recording={UUID}" / "_lease"
        lease.write_text(json.dumps(json.loads(lease.read_text()) | {"token": "another"}))
        with pytest.raises(PoolBusyError, match="ships this recording"):
            shipment.write([logs(2)], {"log": 2})
        lease.unlink()
    with shipping(tmp_path) as shipment:
        assert shipment.progress() == {"log": 1}


def test_a_folder_that_holds_other_things_is_refused_and_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(PoolError, match="holds other things and is no pool"):
        write_all(str(tmp_path), STEPS)
    assert [file.name for file in tmp_path.rglob("*")] == ["thesis.tex"]
    with pytest.raises(PoolError, match=r"thesis.tex.* cannot be a pool"):
        write_all(str(tmp_path / "thesis.tex"), STEPS)


@pytest.mark.parametrize("name", ["_progress", "part"])
def test_what_is_damaged_is_named_and_nothing_is_written_over_it(tmp_path: Path, name: str) -> None:
    write_all(str(tmp_path), STEPS[:2])
    pattern = "_progress" if name == "_progress" else "table=log/day=2023-12-09/*.parquet"
    (file,) = (tmp_path / f"recording={UUID}").glob(pattern)
    file.write_bytes(b"PAR1 and no more")
    with pytest.raises(PoolError, match=r"_progress .*cannot be read|is damaged"):
        write_all(str(tmp_path), STEPS)
    assert file.read_bytes() == b"PAR1 and no more"
    with pytest.raises(PoolError, match=r"_progress .*cannot be read|is damaged"):
        pooled_rows(str(tmp_path), UUID, "log")


@pytest.mark.parametrize(
    ("error", "expected", "text"),
    [
        (
            OSError(errno.ENOSPC, "No space left"),
            PoolUnavailableError,
            "there is no room",
        ),
        (PermissionError(errno.EACCES, "Access Denied"), PoolError, "cannot be used by this user"),
        (OSError(errno.EROFS, "Read-only file system"), PoolError, "cannot be used by this user"),
        (ConnectionResetError(errno.ECONNRESET, "reset"), PoolUnavailableError, "not answer"),
        (RuntimeError("a client's own error"), PoolUnavailableError, "not answer"),
    ],
)
def test_a_storage_that_fails_is_told_and_nothing_is_lost(
    error: Exception, expected: type[PoolError], text: str
) -> None:
    for after in range(3):
        url = bucket.empty()
        write_all(url, STEPS[:1])
        with (
            shipping(url) as shipment,
            bucket.failing(after, error),
            pytest.raises(PoolError, match=text) as raised,
        ):
            shipment.write(STEPS[1], {"step": 2})
        assert type(raised.value) is expected
        write_all(url, STEPS)
        assert (
            ids(pooled_rows(url, UUID, "log")) == sorted(globbed_ids("log")) == [1, 2, 3, 4, 5, 6]
        )


@pytest.mark.skipif(sys.platform == "win32", reason="no limits of this kind")
def test_a_full_folder_is_told_and_the_same_shipment_goes_on_once_there_is_room(
    tmp_path: Path,
) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with shipping(tmp_path) as shipment:
        shipment.write([logs(1)], {"log": 1})
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
        try:
            with pytest.raises(PoolUnavailableError, match="there is no room"):
                shipment.write([logs(2), logs(3, message=os.urandom(20_000).hex())], {"log": 3})
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert len(globbed(tmp_path, "log")) == 1
        shipment.write([logs(2, 3)], {"log": 3})
    assert [row["id"] for row in globbed(tmp_path, "log")] == [1, 2, 3]
    assert list((tmp_path / "_incoming").iterdir()) == []


@pytest.mark.slow
@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="this user may write everywhere")
def test_a_folder_that_may_not_be_written_is_told(tmp_path: Path) -> None:
    with unprivileged.unwritable(tmp_path):
        line = unprivileged.line("-c", HOLDER, str(tmp_path / "pool"), UUID)
        done = subprocess.run(line, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert "PoolError" in done.stderr
    assert "cannot be used by this user" in done.stderr


@pytest.mark.skipif(find_spec("s3fs") is not None, reason="s3fs is installed")
def test_a_filesystem_whose_package_is_missing_names_it() -> None:
    with pytest.raises(PoolError, match="s3fs"):
        ParquetPool("s3://lab/pool")


def test_a_filesystem_that_nobody_knows_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="on no filesystem that fsspec knows"):
        ParquetPool("carrier-pigeon://lab/pool")


@pytest.mark.skipif(sys.platform == "win32", reason="modes of POSIX")
def test_a_new_pool_is_its_owners_alone(tmp_path: Path) -> None:
    with shipping(tmp_path / "pool") as shipment:
        shipment.write([logs(1)], {})
    assert stat.S_IMODE((tmp_path / "pool").stat().st_mode) == 0o700


def test_no_picture_leads_out_of_the_recording(tmp_path: Path) -> None:
    with shipping(tmp_path) as shipment:
        for path in ("../../x.png", "/etc/x.png", "", "a\\..\\b.png"):
            with pytest.raises(PoolError, match="no path of a picture"):
                shipment.write_picture(path, b"")


def test_a_folder_with_signs_of_patterns_in_its_name_is_a_pool_like_others(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "trials [a-c] *?"
    write_all(str(folder), STEPS)
    assert ids(pooled_rows(str(folder), UUID, "log")) == [1, 2, 3, 4, 5, 6]
    with ParquetPool(str(folder)) as pool:
        assert pool.select("SELECT count(*) FROM log", 1).rows == ((6,),)
