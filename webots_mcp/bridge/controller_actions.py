"""The built-in actions on what a controller has declared.

They are reset_state, set_parameters, arm_breakpoints and keep. Each returns a generator, see
`webots_mcp.bridge.control`.
"""

from __future__ import annotations

from typing import cast

from webots_mcp.bridge.breakpoints import Breakpoints
from webots_mcp.bridge.claimed_commands import Action, ClaimedCommand, Progress, Reloads
from webots_mcp.bridge.error_report import describe
from webots_mcp.bridge.full_rate import FullRateRecorder
from webots_mcp.bridge.parameters import Parameters, setter_of
from webots_mcp.bridge.pause_loop import Pause
from webots_mcp.bridge.simulation import Clock
from webots_mcp.errors import CommandRefusedError, InvalidInputError


class ControllerActions:
    """Change what the controller's own code has declared: parameters, breakpoints, callbacks."""

    def __init__(
        self,
        clock: Clock,
        pause: Pause,
        reloads: Reloads,
        parameters: Parameters,
        breakpoints: Breakpoints,
        full_rate: FullRateRecorder,
    ) -> None:
        self._clock = clock
        self._pause = pause
        self._reloads = reloads
        self._parameters = parameters
        self._breakpoints = breakpoints
        self._full_rate = full_rate

    def by_name(self) -> dict[str, Action]:
        """Return the functions by the name of their action."""
        return {
            "reset_state": self.reset_state,
            "set_parameters": self.set_parameters,
            "arm_breakpoints": self.arm_breakpoints,
            "keep": self.keep,
        }

    def reset_state(self, command: ClaimedCommand) -> Progress:
        """Run the callbacks of `on_reload`.

        A function that the controller registered for this action comes first, see `Control`.
        """
        with self._pause.user_code():
            outcomes = self._reloads.call_back()
        if not outcomes:
            raise CommandRefusedError(
                "nothing was reset: this controller registered no callback with bridge.on_reload() "
                "and no function for 'reset_state'; only a loop that handles the return value of "
                "get_command() itself can have reset its state"
            )
        if errors := [describe(error) for error in outcomes if error is not None]:
            raise CommandRefusedError(
                f"{len(errors)} of {len(outcomes)} callbacks failed: {'; '.join(errors)}"
            )
        return {"callbacks": len(outcomes)}
        yield

    def set_parameters(self, command: ClaimedCommand) -> Progress:
        """Set all given parameters or none: `when` "now", or "reset" for the next reset."""
        params, clock, parameters = command.params, self._clock, self._parameters
        values, when = params.get("values"), params.get("when", "now")
        if not isinstance(values, dict) or not values or when not in ("now", "reset"):
            raise InvalidInputError(
                'give values, such as {"kp": 3.0}, and when: "now" or "reset" (at the next reset)'
            )
        setter = setter_of(command.params, command.id)
        given = cast("dict[str, object]", values)
        if when == "reset":
            waiting = parameters.set_from_reset(given, setter)
            shown = {name: {"now": now, "next": then} for name, (now, then) in waiting.items()}
            return {"values": shown, "since": "the next reset"}
        changed = parameters.set_now(given, setter)
        shown = {name: {"old": old, "new": new} for name, (old, new) in changed.items()}
        return {"values": shown, "since_sim_time_s": clock.sim_time_s, "run_id": clock.run.id}
        yield

    def arm_breakpoints(self, command: ClaimedCommand) -> Progress:
        """Read the stored breakpoints again, since some were set or removed."""
        while not self._breakpoints.load():
            yield
        return self._breakpoints.describe()

    def keep(self, command: ClaimedCommand) -> Progress:
        """Keep the last seconds and the next ones at full rate, for a `reason`."""
        reason, sim_time_s = command.params.get("reason"), self._clock.sim_time_s
        if not isinstance(reason, str) or not reason.strip():
            raise InvalidInputError(f"reason must be a text that is not empty, not {reason!r:.80}")
        if not self._full_rate.keep(reason):
            raise CommandRefusedError(self._full_rate.why_not)
        return {"run_id": self._clock.run.id, "kept_around_s": sim_time_s}
        yield
