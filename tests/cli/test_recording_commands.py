"""The commands export, import, prune and keep, as a person runs them."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.store.retention_limits import Limit, parse_limit, size_text
from webots_mcp.store.trial_sets import TrialResult, create_trial_set, finish_trial, trials_of

Say = Callable[..., str]


@pytest.fixture
def database(bridge_recording: Path, tmp_path: Path) -> Path:
    """A copy of the recording that a test may change."""
    folder = tmp_path / "mcp_data"
    shutil.copytree(bridge_recording.parent, folder)
    return folder / bridge_recording.name


@pytest.fixture
def say(database: Path, capsys: pytest.CaptureFixture[str]) -> Say:
    """What a command prints when it succeeds."""

    def said(*arguments: str) -> str:
        assert main([*arguments, "--database", str(database)]) == 0
        return capsys.readouterr().out

    return said


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    return said.err


def query(database: Path, sql: str) -> list[Any]:
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(sql).fetchall()


# -- export ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_export_writes_csv_to_a_pipe(database: Path) -> None:
    line = [sys.executable, "-m", "webots_mcp", "export", "--database", str(database), "--run", "1"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=60, check=True)
    rows = list(csv.DictReader(io.StringIO(done.stdout)))
    assert len(rows) == 530
    assert rows[0]["mode"] == "cruise"
    assert done.stderr == ""


def test_export_takes_the_format_from_the_name(say: Say, tmp_path: Path) -> None:
    file = tmp_path / "run.jsonl"
    assert say("export", "-o", str(file), "--since", "0") == f"Exported 857 rows to {file}.\n"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert {line["run_id"] for line in lines} == {1, 2}


def test_export_of_parquet_can_be_read_back(say: Say, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="the extra 'parquet' is not installed")
    file = tmp_path / "run.parquet"
    say("export", "-o", str(file), "--run", "1", "--start", "0", "--end", "8")
    assert set(parquet.read_table(file).column("mode").to_pylist()) == {"cruise"}


def test_export_for_viewers_tells_what_the_file_holds_and_where_the_layout_is(
    say: Say, tmp_path: Path
) -> None:
    file = tmp_path / "run.mcap"
    said = say("export", "-o", str(file), "--run", "1", "--start", "0", "--end", "8")
    layout = tmp_path / "run.layout.json"
    assert said.startswith("Exported 249 states, ")
    assert said.endswith(f" to {file}. Layout for Foxglove and Lichtblick: {layout}\n")
    assert sorted(tmp_path.glob("run.*")) == [layout, file]


def test_export_writes_the_trials_of_a_set(
    say: Say, database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(connect(database, "writer")) as connection:
        set_id = create_trial_set(connection, "{}", [{"kp": 1.0}, {"kp": 2.0}])
        for trial in trials_of(connection, set_id):
            finish_trial(connection, trial, TrialResult(None, trial.values["kp"] * 2, None))
    file = tmp_path / "trials.csv"
    assert (
        say("export", "--trials", str(set_id), "-o", str(file)) == f"Exported 2 rows to {file}.\n"
    )
    rows = list(csv.DictReader(io.StringIO(file.read_text())))
    assert [(row["kp"], row["score"], row["rank"]) for row in rows] == [
        ("1.0", "2.0", "2"),
        ("2.0", "4.0", "1"),
    ]
    line = ("export", "--database", str(database), "--trials", "1", "--last", "5")
    assert "--trials cannot be combined with" in complaint(capsys, *line)


@pytest.mark.parametrize("output", ["a.csv", "-"])
def test_a_range_beyond_the_recording_is_noted_beside_the_table(
    database: Path, tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes], output: str
) -> None:
    file = str(tmp_path / output) if output != "-" else output
    asked = ["export", "-o", file, "--run", "1", "--end", "99", "--database", str(database)]
    assert main(asked) == 0
    said = capfdbinary.readouterr()
    assert b"note: the recording of run 1 ends at" in said.err
    assert b"note" not in said.out


def test_export_never_overwrites_the_recording(
    database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("export", "--database", str(database), "--format", "csv", "-o", str(database))
    assert "is the recording itself" in complaint(capsys, *arguments)
    assert query(database, "SELECT count(*) FROM run") == [(2,)]


@pytest.mark.parametrize("number", [str(2**63), "1.5", "x", "-1"])
@pytest.mark.parametrize("asked", ["export --run {}", "export --trials {}", "retain {}"])
def test_an_id_that_no_row_can_have_is_refused_and_the_option_named(
    capsys: pytest.CaptureFixture[str], asked: str, number: str
) -> None:
    said = complaint(capsys, *asked.format(number).split())
    assert number in said
    assert asked.partition(" --")[2].partition(" ")[0] in said


def test_export_tells_a_program_what_a_file_got(say: Say, tmp_path: Path) -> None:
    def told(name: str, *more: str) -> Any:
        return json.loads(say("export", "--json", "-o", str(tmp_path / name), *more))

    table = told("run.jsonl", "--run", "1", "--end", "99")
    assert (table["file"], table["row_count"]) == (str(tmp_path / "run.jsonl"), 530)
    assert "ends at" in table["notes"][0]
    counts = told("run.mcap", "--run", "1")["counts"]
    assert (counts["states"], " " in "".join(counts)) == (530, False)


def test_what_export_tells_is_not_mixed_with_a_table_on_stdout(
    database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", "--json", "--database", str(database)]) == 2
    assert "--json describes an exported file" in json.loads(capsys.readouterr().out)["error"]


# -- import ---------------------------------------------------------------------------------------


def test_import_takes_in_another_recording_with_its_trials_once(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(connect(database, "writer")) as connection:
        connection.execute("UPDATE session SET ended_wall_time_s = 1.0")
        set_id = create_trial_set(connection, '{"score": "duration"}', [{"kp": 1.0}])
        finish_trial(connection, trials_of(connection, set_id)[0], TrialResult(2, 4.5, None))
    new = tmp_path / "new" / "webots.db"
    for told in (
        f"Imported runs 1 to 2 from {database}.",
        f"Nothing new in {database}: runs 1 to 2 were imported before.",
    ):
        assert main(["import", str(database), "--data-dir", str(new.parent)]) == 0
        assert capsys.readouterr().out == f"{told}\n"
        assert query(new, "SELECT status, score, run_id FROM trial") == [("done", 4.5, 2)]
        assert query(new, "SELECT count(*) FROM run") == [(2,)]
    said = complaint(capsys, "import", str(new), "--database", str(new))
    assert "is the recording that would be imported into" in said


def test_a_bundle_goes_from_one_recording_to_another(
    database: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with closing(connect(database, "writer")) as connection:
        connection.execute("UPDATE session SET ended_wall_time_s = 1.0")
        connection.execute("UPDATE run SET ended_wall_time_s = 1.0")
    file, new = tmp_path / "run.zip", tmp_path / "new"
    assert main(["export", "--run", "2", "-o", str(file), "--database", str(database)]) == 0
    assert capsys.readouterr().out == (
        f"Exported run 2 ({file.stat().st_size:,} bytes) to {file}.\n"
    )
    for told in (
        f"Imported run 1 from {file}.",
        f"Nothing new in {file}: run 1 was imported before.",
    ):
        assert main(["import", str(file), "--data-dir", str(new)]) == 0
        assert capsys.readouterr().out == f"{told}\n"
    assert main(["import", str(file), "--data-dir", str(new), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "source": str(file), "new_run_ids": [], "known_run_ids": [1], "changed": False,
    }  # fmt: skip
    assert query(new / "webots.db", "SELECT count(*) FROM state") == [(327,)]
    assert main(["import", str(database), "--data-dir", str(new)]) == 0
    assert capsys.readouterr().out == (
        f"Imported run 2 from {database}; run 1 was imported before.\n"
    )
    with closing(connect(database, "writer")) as connection:
        create_trial_set(connection, '{"score": "duration"}', [{"kp": 1.0}])
    assert main(["import", str(database), "--data-dir", str(new)]) == 0
    assert "no new run" in capsys.readouterr().out
    line = ("export", "--last", "5", "-o", str(file), "--database", str(database))
    assert "bundle holds a whole run" in complaint(capsys, *line)


def test_what_says_it_is_a_bundle_and_is_none_makes_no_database(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.zip"
    file.write_bytes(b"PK")
    said = complaint(capsys, "import", str(file), "--data-dir", str(tmp_path / "new"))
    assert f"{file} is damaged" in said
    assert not (tmp_path / "new").exists()


def test_what_is_no_recording_is_not_imported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "other.db"
    file.write_text("notes")
    assert str(file) in complaint(capsys, "import", str(file), "--data-dir", str(tmp_path / "new"))
    assert not (tmp_path / "new").exists()


# -- prune and keep -------------------------------------------------------------------------------


def test_a_dry_run_tells_what_would_go_and_deletes_nothing(say: Say, database: Path) -> None:
    before = query(database, "SELECT count(*) FROM state")
    text = say("prune", "--dry-run", "--keep-states", "400rows")
    answer, *table, disk = text.splitlines()
    assert answer.startswith("Would delete 530 rows beyond the limits, about ")
    assert [line.split()[:2] for line in table] == [["kind", "rows"], ["state", "530"]]
    assert disk.startswith("note: the file takes ") and ": states " in disk
    assert query(database, "SELECT count(*) FROM state") == before


def test_prune_deletes_what_the_dry_run_told(say: Say, database: Path) -> None:
    text = say("prune", "--keep-states", "400rows", "--keep-images", "all")
    answer, _, states, *_ = text.splitlines()
    assert answer.startswith("Deleted 530 rows beyond the limits, about ")
    assert states.split()[:2] == ["state", "530"]
    assert query(database, "SELECT run_id, row_count, purged_rows FROM robot_run") == [
        (1, 530, 530),
        (2, 327, 0),
    ]
    assert query(database, "PRAGMA integrity_check") == [("ok",)]
    assert say("prune", "--keep-states", "400rows") == "Nothing is beyond the limits.\n"


def test_what_is_pruned_is_told_to_programs_in_bytes_and_ids(say: Say, database: Path) -> None:
    limits = json.loads(say("retention", "2", "--keep-states", "0rows", "--json"))
    assert (limits["run_ids"], limits["retained"]) == ([2], True)
    assert limits["limits"]["states"].startswith("0rows (set by retain")
    tried = json.loads(say("prune", "--dry-run", "--json"))
    (states,) = tried["goes"]
    assert (states["table"], states["row_count"], states["run_ids"]) == ("state", 530, [1])
    assert tried["retained"]["run_ids"] == [2]
    assert tried["disk_bytes"]["file"] == database.stat().st_size
    done = json.loads(say("prune", "--json"))
    assert (done["goes"], done["notes"]) == (tried["goes"], [])
    assert done["freed_bytes"] > 0
    assert query(database, "SELECT purged_rows FROM run ORDER BY id") == [(530,), (0,)]


def test_a_run_that_is_kept_is_named_and_stays(say: Say, database: Path) -> None:
    assert say("retention", "1") == "Marked run 1: never pruned.\n"
    nothing, note = say("prune", "--keep-states", "400rows").splitlines()
    assert nothing == "Nothing is beyond the limits."
    assert "kept because of a label, a note or a mark, and not counted: run 1, about " in note
    released = say("retention", "1", "--release")
    assert released == "Removed the mark from run 1: retention applies again.\n"
    say("prune", "--keep-states", "400rows")
    assert query(database, "SELECT purged_rows FROM run WHERE id = 1") == [(530,)]


def test_what_is_too_old_but_among_the_newest_is_told(say: Say, database: Path) -> None:
    text = say("prune", "--dry-run", "--keep-states", "0s")
    assert "beyond the limit, but kept: 857 rows of state, about " in text
    assert "too old, but among the newest 50000" in text


def test_a_run_that_does_not_exist_cannot_be_kept(
    database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "No run 9" in complaint(capsys, "retention", "9", "--database", str(database))


@pytest.mark.parametrize("limit", ["", "none", "500", "5 parsecs", "1GB,2GB", "-3d", "1GB;2d"])
def test_a_limit_that_is_none_is_told_how_to_write_one(
    limit: str, database: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("prune", "serve"):
        said = complaint(capsys, command, f"--keep-states={limit}", "--database", str(database))
        assert "500MB" in said or "twice" in said


@pytest.mark.parametrize(
    "arguments", [["export"], ["prune"], ["prune", "--dry-run"], ["retention", "1"]]
)
def test_without_a_recording_each_says_so(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "no database at" in complaint(capsys, *arguments, "--data-dir", str(tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_progress_is_shown_on_a_terminal_and_vanishes(database: Path) -> None:
    pty = pytest.importorskip("pty", reason="terminals like these are of Unix")
    parent, child = pty.openpty()
    line = [sys.executable, "-m", "webots_mcp", "export", "--database", str(database)]
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=child, timeout=60, check=True)
    os.close(child)
    shown = os.read(parent, 10_000).decode()
    os.close(parent)
    assert "exporting: " in shown
    assert shown.endswith("\r\x1b[K")
    assert b"exporting" not in done.stdout


# -- how limits are written -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        ("500MB", Limit(size_bytes=500_000_000)),
        ("1.5 gb, 30d", Limit(size_bytes=1_500_000_000, age_s=30 * 86_400)),
        ("2h,100000rows", Limit(age_s=7200, rows=100_000)),
        ("all", Limit()),
        ("0rows", Limit(rows=0)),
    ],
)
def test_limits_are_read_as_they_are_written(text: str, limit: Limit) -> None:
    assert parse_limit(text, Limit()) == limit


@pytest.mark.parametrize("times", ["0", "none", "nan", "-1"])
def test_how_long_runs_are_kept_cannot_be_written_the_wrong_way_round(
    times: str, capsys: pytest.CaptureFixture[str]
) -> None:
    said = complaint(capsys, "prune", "--keep-runs", times)
    assert f"--keep-runs: {times!r} is not a number of times. Give a number from 1, or all." in said


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e9, "2.50 GB")]
)
def test_sizes_are_written_as_they_are_read(size: float, text: str) -> None:
    assert size_text(size) == text


@pytest.mark.parametrize("name", ["nothing.zip", "nothing.db", "nothing"])
def test_a_recording_to_import_that_is_not_there_is_told(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = complaint(capsys, "import", str(tmp_path / name), "--data-dir", str(tmp_path / "new"))
    assert f"{tmp_path / name} cannot be imported: there is no such file" in said
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("more", "told"),
    [(("--format", "mcap"), "Name a file with -o"), (("-o", "a.mcap", "--trials", "1"), "a table")],
)
def test_what_viewers_read_is_neither_for_a_pipe_nor_of_trials(
    database: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], told: str
) -> None:
    assert told in complaint(capsys, "export", "--database", str(database), *more)
