"""Retention: how much of a recording is kept, what would go, and how it goes.

`policy` states what limits are, `limits` those of a database; `planning` finds what is beyond them,
`purge` deletes it a little at a time, `upkeep` does so for a maintainer.
"""

from webots_mcp.store.retention.limits import Asked, in_force
from webots_mcp.store.retention.planning import Plan, Step, plan
from webots_mcp.store.retention.policy import DEFAULT, Limit, Retention, mark_kept
from webots_mcp.store.retention.purge import Purged, prune
from webots_mcp.store.retention.upkeep import Upkeep

__all__ = [
    "DEFAULT",
    "Asked",
    "Limit",
    "Plan",
    "Purged",
    "Retention",
    "Step",
    "Upkeep",
    "in_force",
    "mark_kept",
    "plan",
    "prune",
]
