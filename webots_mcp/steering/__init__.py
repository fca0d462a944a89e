"""Steering a simulation: commands, other routes to Webots, and trials."""
