"""Steering a simulation: commands, other routes to Webots, trials, edits of the scene."""
