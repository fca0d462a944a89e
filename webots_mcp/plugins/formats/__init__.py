"""Export formats that need extra packages: Parquet, MCAP and recordings of Rerun."""

from webots_mcp.extras.plugin_registry import ExportFormat, Plugin

PLUGIN = Plugin(
    formats=(
        ExportFormat("parquet", ("parquet", "pq"), f"{__name__}.parquet:write_parquet", passes=2),
        ExportFormat("mcap", ("mcap",), f"{__name__}.mcap:export_mcap", for_viewers=True),
        ExportFormat("rrd", ("rrd",), f"{__name__}.rrd:export_rrd", for_viewers=True),
    )
)
