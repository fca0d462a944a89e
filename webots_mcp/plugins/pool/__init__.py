"""Pools: many recordings in one store, shipped by the machines that recorded them.

A pool is a PostgreSQL database, or a dataset of Parquet files that other engines can read. The key
of a row is the UUID of its recording plus its key there. `pool_interface` defines what a pool can
do; `pool_contents` opens one of the two kinds, `postgres_pool` and `parquet_pool`.
"""

from webots_mcp.extras.plugin_registry import Plugin, PluginCommand

PLUGIN = Plugin(
    commands=tuple(
        PluginCommand(name, "Recordings", f"{__name__}.pool_commands:{name}")
        for name in ("fetch", "pool", "ship")
    )
)
