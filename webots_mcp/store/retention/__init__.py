"""Retention: how much of a recording is kept, what would go, and how it goes.

`policy` states what limits are, `limits` those of a database; `planning` finds what is beyond them,
`purge` deletes it a little at a time, `upkeep` does so for a maintainer.
"""
