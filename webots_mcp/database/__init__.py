"""The SQLite file that bridge and server share: its queue and upkeep, and files next to it.

Both sides of a recording use these modules, the bridge inside the robot's controller. They import
the standard library, `signals`, `contract` and `errors` only.
"""
