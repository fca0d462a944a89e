"""Trials on the workers of a Dask cluster. Needs the extra `cluster`."""

from webots_mcp.extras.plugin_registry import Plugin

PLUGIN = Plugin(cluster=f"{__name__}.dask_cluster:cluster")
