"""PostgreSQL as a pool: `schema` and `views` make it, `writing` fills it, `reading` asks it.

It needs psycopg, which is an extra.
"""

from __future__ import annotations

from webots_mcp.errors import PoolError

try:
    import psycopg as psycopg
except ImportError as missing:  # psycopg itself, or a libpq for it
    raise PoolError(
        "a pool in PostgreSQL needs psycopg: pip install 'webots-mcp[postgres]' "
        "(the extra [postgres] of webots-mcp)"
    ) from missing
