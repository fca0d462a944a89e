"""Conditions on the signals of a robot: `front_m < 0.1 for 0.5`; see 'webots-mcp help conditions'.

The controller's side asks them of each published state, the server's side of recorded rows, and
both get the same answer.
"""

from webots_mcp.signals.conditions.compiler import Condition, Evaluator, parse_condition

__all__ = ["Condition", "Evaluator", "parse_condition"]
