"""Why nothing works: each link between a controller and its asker, looked at by itself.

A check is one function that returns a `Finding`, and one line in `registry.CHECKS`. What it says
goes on in docs/troubleshooting.md, under a heading of its name.
"""
