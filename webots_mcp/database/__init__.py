"""The SQLite file that bridge and server share: connection, command queue, dead sessions, upkeep.

Both sides of a recording use these modules, the bridge inside the robot's controller. They import
the standard library, `signals`, `contract` and `errors` only.
"""
