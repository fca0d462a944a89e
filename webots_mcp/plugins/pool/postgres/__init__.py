"""PostgreSQL as a pool: `schema` and `views` make it, `writing` fills it, `reading` asks it.

It needs psycopg, which is an extra.
"""

from __future__ import annotations

from webots_mcp.errors import PoolError
from webots_mcp.requirements import explain_extra

try:
    import psycopg as psycopg
except ImportError as missing:  # psycopg itself, or a libpq for it
    raise PoolError(explain_extra("a pool in PostgreSQL", "postgres")) from missing
