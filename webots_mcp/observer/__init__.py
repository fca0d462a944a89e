"""The observer: a robot of the world that only looks, records what it sees, and steers.

It is a Supervisor with a bridge of its own, so that nothing has to be changed in the controllers of
the robots that it watches. Standard library only: it runs inside a controller.
"""
