"""Opening the pool that a URL names: PostgreSQL, or a dataset of Parquet files.

`postgresql://[USER@]HOST[:PORT]/DATABASE` and `postgresql:///?service=NAME` are PostgreSQL; a
folder, `file:///FOLDER` and any other URL that fsspec knows are a dataset of Parquet files.
Passwords come from PGPASSWORD, ~/.pgpass or a service file: in a URL, every process would see them.
"""

from __future__ import annotations

import re
from typing import Final

from webots_mcp.errors import InvalidInputError
from webots_mcp.plugins.pool.target import Pool, Target, require_no_secret

_CONNECTION_STRING: Final = re.compile(
    r"(^|\s)(host|hostaddr|dbname|user|password|passfile|service)\s*=", re.IGNORECASE
)
_NEARLY_A_URL: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
_POSTGRES: Final = ("postgresql", "postgres")


def open_target(url: str) -> Target:
    """The pool of a URL, to ship to: not yet connected. What it needs is imported only here.

    Raises:
        InvalidInputError: The URL names no pool, or holds a secret.
        PoolError: The packages of an extra are missing.
    """
    if _is_postgres(url):
        from webots_mcp.plugins.pool.postgres.postgres_writing import PostgresTarget

        return PostgresTarget(url)
    from webots_mcp.plugins.pool.parquet.parquet_writing import ParquetTarget

    return ParquetTarget(url)


def open_pool(url: str) -> Pool:
    """The pool of a URL, to read from; as `open_target`."""
    if _is_postgres(url):
        from webots_mcp.plugins.pool.postgres.postgres_reading import PostgresPool

        return PostgresPool(url)
    from webots_mcp.plugins.pool.parquet.parquet_reading import ParquetPool

    return ParquetPool(url)


def pause_of(url: str) -> float:
    """How long to wait between two looks at a recording: of small files a pool has soon many."""
    return 2.0 if _is_postgres(url) else 60.0


def _is_postgres(url: str) -> bool:
    """Whether it is PostgreSQL rather than files.

    Raises:
        InvalidInputError: It holds a secret, or is no URL and no folder.
    """
    if not url.strip():
        raise InvalidInputError("the URL is empty: give postgresql://HOST/DATABASE or a folder")
    scheme, sign, _ = url.partition("://")
    if sign:
        require_no_secret(url)
        return scheme.lower() in _POSTGRES
    if _CONNECTION_STRING.search(url):
        raise InvalidInputError(
            "a connection string of PostgreSQL is no URL: write postgresql://USER@HOST/DATABASE, "
            "and give the password in PGPASSWORD, ~/.pgpass or a service file"
        )
    if _NEARLY_A_URL.match(url):
        raise InvalidInputError(
            f"{url!r} is neither a URL nor a folder: write postgresql://HOST/DATABASE, "
            "s3://BUCKET/PREFIX or ./FOLDER"
        )
    return False
