"""A real PostgreSQL for tests: a server of its own in a folder of its own, as fast as it can be.

Tests that need it are skipped where there is no PostgreSQL 14 or newer; `./run tests` installs
Debian's where it may.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote, urlencode

import psycopg
import pytest

DEBIAN: Final = Path("/usr/lib/postgresql")  # its programs are not on PATH
OLDEST: Final = 14
OWNER: Final = "postgres"
CONFIGURATION: Final = """
fsync = off
full_page_writes = off
shared_buffers = 32MB
max_connections = 40
autovacuum = off
jit = off
log_statement = none
log_min_error_statement = panic
"""
# Whoever is called so has to tell a password.
ACCESS: Final = """
local all guarded scram-sha-256
local all all trust
host all all 127.0.0.1/32 trust
"""


def find_programs() -> Path | None:
    """The folder of the newest PostgreSQL here that is new enough; None without any."""
    found = sorted((each for each in DEBIAN.glob("*/bin/initdb")), key=_debian_version)
    if on_path := shutil.which("initdb"):
        found.append(Path(on_path))
    usable = [each.parent for each in found if _version(each) >= OLDEST]
    return usable[-1] if usable else None


def _debian_version(program: Path) -> float:
    return float(program.parts[-3])


def _version(program: Path) -> int:
    said = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    return int(said.stdout.split()[2].split(".")[0].split("devel")[0])


class Disk:
    """A disk of a few megabytes, and the tablespace on it."""

    def __init__(self, folder: Path, tablespace: str) -> None:
        self._filling, self.tablespace = folder / "filling", tablespace

    def fill(self) -> None:
        """Leave no byte of it."""
        with contextlib.suppress(OSError), self._filling.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))

    def empty(self) -> None:
        """Give the room back."""
        self._filling.unlink()


class Server:
    """A PostgreSQL server that a test may stop, start and ask as its superuser."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self._programs, self.folder, self.port = programs, folder, _free_port()
        self._names = itertools.count(1)

    def make(self) -> None:
        """Make the files of a server, and start it."""
        if os.geteuid() == 0:  # which initdb refuses
            shutil.chown(self.folder, OWNER, OWNER)
        arguments = ["-D", self.data, "-U", OWNER, "-A", "trust", "-E", "UTF8", "--locale=C"]
        self._run("initdb", *arguments, "--no-sync", "--no-instructions")
        with (self.data / "postgresql.conf").open("a") as settings:
            settings.write(CONFIGURATION)
        (self.data / "pg_hba.conf").write_text(ACCESS)
        self.start()

    @property
    def data(self) -> Path:
        """The folder of its data."""
        return self.folder / "data"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-k {self.folder} -p {self.port} -c listen_addresses=127.0.0.1"
        log = self.folder / "server.log"
        self._run("pg_ctl", "start", "-w", "-D", self.data, "-l", log, "-o", options)

    def stop(self, how: str = "immediate") -> None:
        """Stop it: `immediate` as if the power had failed, `fast` in good order."""
        self._run("pg_ctl", "stop", "-w", "-D", self.data, "-m", how)

    def url(self, database: str, user: str = OWNER, **options: str) -> str:
        """The URL of one of its databases."""
        asked = {"host": str(self.folder), "port": str(self.port), **options}
        return f"postgresql://{quote(user)}@/{database}?{urlencode(asked, quote_via=quote)}"

    def new_database(self, template: str = "template1", tablespace: str = "pg_default") -> str:
        """The name of a new one, as a template is."""
        name = f"pool_{next(self._names)}"
        made = f"CREATE DATABASE {name} TEMPLATE {template} TABLESPACE {tablespace}"
        self.execute("postgres", made)
        return name

    @contextmanager
    def small_disk(self, size_mb: int) -> Generator[Disk]:
        """A disk of its own, for a database; skips the test where none can be mounted."""
        folder = self.folder / "disk"
        folder.mkdir()
        options = f"size={size_mb}m,mode=0777"
        mount = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
            pytest.skip("no disk of a few megabytes can be mounted here")
        try:
            (folder / "tables").mkdir()
            if os.geteuid() == 0:
                shutil.chown(folder / "tables", OWNER, OWNER)
            self.execute("postgres", f"CREATE TABLESPACE small LOCATION '{folder / 'tables'}'")
            yield Disk(folder, "small")
            self.execute("postgres", "DROP TABLESPACE small")
        finally:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
            folder.rmdir()

    def execute(self, database: str, sql: str, *arguments: Any) -> list[tuple[Any, ...]]:
        """What a statement of the superuser gives."""
        with psycopg.connect(self.url(database), autocommit=True) as connection:
            cursor = connection.execute(sql.encode(), arguments or None)
            return cursor.fetchall() if cursor.description else []

    def end_backends(self, database: str) -> int:
        """End all that are connected to a database; returns how many there were."""
        sql = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s"
        return len(self.execute("postgres", sql, database))

    def _run(self, program: str, *arguments: str | Path) -> None:
        owner: dict[str, Any] = {"user": OWNER, "group": OWNER, "extra_groups": []}
        ended = subprocess.run(
            [self._programs / program, *arguments],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
            cwd=self.folder, check=False, **(owner if os.geteuid() == 0 else {}),
        )  # fmt: skip
        assert ended.returncode == 0, ended.stderr.decode()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class NoServerError(Exception):
    """There can be no PostgreSQL server here; the text says why."""


@contextmanager
def running_server() -> Generator[Server]:
    """A server as long as the block runs.

    Raises:
        NoServerError: There can be none.
    """
    programs = _usable_programs()
    # A socket's path is short, and the folders of pytest are closed to other users.
    folder = Path(tempfile.mkdtemp(prefix="pg-"))
    folder.chmod(0o755)
    server = Server(programs, folder)
    try:
        server.make()
        yield server
    finally:
        if (server.data / "postmaster.pid").exists():
            server.stop()
        shutil.rmtree(folder)


def _usable_programs() -> Path:
    if sys.platform == "win32":
        raise NoServerError("the tests start PostgreSQL on a Unix socket")
    programs = find_programs()
    if programs is None:
        raise NoServerError(f"there is no PostgreSQL {OLDEST} or newer")
    if os.geteuid() == 0 and not _is_user(OWNER):
        raise NoServerError(f"PostgreSQL does not run as root, and there is no user {OWNER!r}")
    return programs


def _is_user(name: str) -> bool:
    import pwd  # not on Windows

    return name in {each.pw_name for each in pwd.getpwall()}
