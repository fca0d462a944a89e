"""Webots as a program: finding, starting and steering it, its console, its project, the observer.

Nothing here answers questions. Steering, set-up and the command line use it; it imports `store`
and everything below, and the bridge for the observer.
"""
