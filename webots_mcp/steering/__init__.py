"""Steering a simulation: commands to controllers, other routes to Webots, and trials.

Questions, the server and the command line use it. Each request asks for permission where it is
carried out, in `store.requests`.
"""
