"""The calls of a controller as a file, the tape, and the controller's new code run on it.

The recording half (the modules whose names begin with `tape`, and `source_files`) runs inside a
robot's controller. The rest replays a tape in a process of its own. It may import `database` and
everything below; the bridge, the store and everything above may import it. Standard library only.
"""
