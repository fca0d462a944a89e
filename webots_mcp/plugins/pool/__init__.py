"""Many recordings in one store: shipping recordings to a pool, and reading it.

A pool is a PostgreSQL database or a dataset of Parquet files that other people's engines read.
Each row is keyed by its recording's UUID and the key that it has there. `tables` says what is
shipped, `target` what a pool can do; `engines` opens one of the two kinds, which are `postgres` and
`parquet`.
"""

from webots_mcp.plugins import Plugin

PLUGIN = Plugin(command_modules=(f"{__name__}.pool_commands", f"{__name__}.ship_command"))
