"""Many recordings in one store: shipping recordings to a pool, and reading it.

A pool is a PostgreSQL database or a dataset of Parquet files that other people's engines read.
Each row is keyed by its recording's UUID and the key that it has there. `pool_interface` says what
a pool can do; `pool_contents` opens one of the two kinds, which are `postgres_pool` and
`parquet_pool`.
"""

from webots_mcp.extras.plugins import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=tuple(
        PluginCommand(name, "Recordings", f"{__name__}.pool_commands:{name}")
        for name in ("fetch", "pool", "ship")
    )
)
