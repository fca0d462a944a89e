"""The built-in actions that show a controller's own variables: inspect and watch.

Each returns a generator, see `webots_mcp.bridge.control`. The loop is in a call of the bridge then,
and its variables are those of the code that made the call.
"""

from __future__ import annotations

from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress
from webots_mcp.bridge.controller_variables import ControllerVariables
from webots_mcp.bridge.recorder import this_call


class InspectionActions:
    """Look at the variables of the controller; nothing can be set."""

    def __init__(self, variables: ControllerVariables) -> None:
        self._variables = variables

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {"inspect": self.inspect, "watch": self.watch}

    def inspect(self, command: ClaimedCommand) -> Progress:
        """Show the frames of the loop with their variables, or the value at `path`."""
        return self._variables.show(command.params.get("path"), this_call())
        yield

    def watch(self, command: ClaimedCommand) -> Progress:
        """Record the value at `path` with each state from now on, or `stop`."""
        return self._variables.watch(command.params, this_call())
        yield
