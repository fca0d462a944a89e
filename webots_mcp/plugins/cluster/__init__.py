"""Trials on the workers of a Dask cluster. Needs the extra `cluster`."""

from webots_mcp.extras.plugins import Plugin

PLUGIN = Plugin(cluster=f"{__name__}.dask_cluster:cluster")
