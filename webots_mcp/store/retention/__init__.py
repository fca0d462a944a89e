"""Retention: how much of a recording is kept, what would go, and how it goes.

`policy` states the limits, `planning` finds what is beyond them, `purge` deletes it a little at a
time, `upkeep` does so for a maintainer, once a minute.
"""

from webots_mcp.store.retention.planning import Plan, Step, plan
from webots_mcp.store.retention.policy import DEFAULT, Limit, Retention, mark_kept
from webots_mcp.store.retention.purge import Purged, prune
from webots_mcp.store.retention.upkeep import Upkeep

__all__ = [
    "DEFAULT",
    "Limit",
    "Plan",
    "Purged",
    "Retention",
    "Step",
    "Upkeep",
    "mark_kept",
    "plan",
    "prune",
]
