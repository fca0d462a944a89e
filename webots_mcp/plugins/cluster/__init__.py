"""Trials on the workers of a Dask cluster. Needs the extra `cluster`."""

from webots_mcp.plugins import Cluster, Plugin

PLUGIN = Plugin(
    cluster=Cluster(
        simulators=f"{__name__}.dask_cluster:cluster",
        worker=f"{__name__}.dask_cluster:ClusterWorker",
    )
)
