"""A reader that holds a snapshot is warned about long before the log has filled the disk."""

from __future__ import annotations

import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main
from webots_mcp.connection import connect
from webots_mcp.maintenance import HELD_LOG_BYTES, Maintainer

HOLDER = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN")
connection.execute("SELECT count(*) FROM state").fetchone()
print("held", flush=True)
sys.stdin.read()
"""


@pytest.mark.slow
def test_a_transaction_of_another_program_is_warned_about_until_it_ends(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = tmp_path / "webots.db"
    recorded = Recorded(database)
    robot = recorded.robot()
    robot.state(0.1, {"n": 0})
    robot.end_run("finished")
    recorded.close()
    command = [sys.executable, "-c", HOLDER, str(database)]
    pipe = subprocess.PIPE
    maintainer = Maintainer(database, "server")
    with (
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as holder,
        closing(connect(database, "writer")) as connection,
    ):
        assert holder.stdout and holder.stdout.readline() == "held\n"
        connection.execute("CREATE TABLE filling (data)")
        log, size = Path(f"{database}-wal"), 4_000_000
        for _ in range(2 * HELD_LOG_BYTES // size):
            connection.execute("INSERT INTO filling VALUES (zeroblob(?))", (size,))
            maintainer.tick()
            if log.stat().st_size > HELD_LOG_BYTES:
                break
        for _ in range(3):
            maintainer.tick()
        assert capsys.readouterr().err.count("webots.db-wal has grown to") == 1
        for arguments in (["status"], ["doctor"]):
            main([*arguments, "--data-dir", str(tmp_path)])
            said = "".join(capsys.readouterr())
            assert "holds a read transaction" in " ".join(said.split())
        holder.communicate()
        for _ in range(3):
            maintainer.tick()
        assert log.stat().st_size < HELD_LOG_BYTES
        main(["status", "--data-dir", str(tmp_path)])
        assert "has grown to" not in "".join(capsys.readouterr())
    maintainer.stop()
