"""The new code of a controller, run on the tape of an old run: replay, comparison, deciding line.

A tape is replayed in a process of its own. What records a tape runs inside a robot's controller
(`bridge.tape_recorder`), and its format is shared (`database.tape`). Standard library only.
"""
