"""Many recordings in one store: shipping recordings to a pool, and reading it.

A pool is a PostgreSQL database or a dataset of Parquet files that other people's engines read.
Each row is keyed by its recording's UUID and the key that it has there. `tables` says what is
shipped, `target` what a pool can do; `engines` opens one of the two kinds, which are `postgres` and
`parquet`.
"""

from webots_mcp.plugins import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=tuple(
        PluginCommand(name, "Recordings", f"{__name__}.pool_commands:{name}")
        for name in ("fetch", "pool", "ship")
    )
)
