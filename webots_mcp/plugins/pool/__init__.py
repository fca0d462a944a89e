"""Many recordings in one store: shipping recordings to a pool, and reading it.

A pool is a PostgreSQL database or a dataset of Parquet files that other people's engines read.
Each row is keyed by its recording's UUID and the key that it has there. `tables` says what is
shipped, `target` what a pool can do; `postgres` and `parquet` are the two kinds.
"""

from webots_mcp.plugins import Plugin

PLUGIN = Plugin(commands=(f"{__name__}.pool_commands", f"{__name__}.ship_command"))
