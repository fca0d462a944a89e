"""The custom actions: functions of the controller that an assistant may have run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from webots_mcp.bridge.commands import ClaimedCommand
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.pause import Pause
from webots_mcp.bridge.recorder import Recorder
from webots_mcp.bridge.text import cut, storable
from webots_mcp.contract import BUILT_IN_ACTIONS
from webots_mcp.errors import CommandRefusedError
from webots_mcp.naming import nearest_first, same_in_meaning

Handler = Callable[[dict[str, Any]], object]

_MOST_NAME_CHARACTERS: Final = 100
_MOST_DOC_CHARACTERS: Final = 4000


class Handlers:
    """The registered functions by the name of their action.

    Attributes:
        running: A function is at work: this call comes from within it.
        loop_looks: The loop asks for commands, and may do something with what it gets.
    """

    def __init__(self, recorder: Recorder, journal: Journal, pause: Pause) -> None:
        self._recorder = recorder
        self._journal = journal
        self._pause = pause
        self._handlers: dict[str, Handler] = {}
        self._refused: set[str] = set()
        self.running = False
        self.loop_looks = True

    def register(self, action: str, handler: Handler) -> None:
        """Make a custom action known, here and in the session's row.

        A built-in action stays what it is, but that one which calls functions of the controller
        anyway (`reset_state`) calls this one.

        Raises:
            ValueError: The name is empty, too long, or no text that can be sent.
            TypeError: The name is no text, or the handler is not a plain function.
        """
        _require_name(action)
        built_in = BUILT_IN_ACTIONS.get(action)
        if built_in is not None and not built_in.runs_user_code:
            self._refuse(action)
            return
        import inspect  # only here: it would be a fifth of the bridge's import time

        if not callable(handler) or inspect.iscoroutinefunction(handler):
            raise TypeError(f"the handler of {action!r} must be a plain function, not {handler!r}")
        written = getattr(handler, "__doc__", None)
        doc = inspect.cleandoc(written) if isinstance(written, str) else ""
        if built_in is not None and action not in self._handlers:
            why = "its own function is run, in place of the callbacks of on_reload()"
            self._journal.log("info", "bridge", f"the controller has registered {action!r}: {why}")
        self._handlers[action] = handler
        self._recorder.session.actions[action] = storable(cut(doc, _MOST_DOC_CHARACTERS))
        self._recorder.update_actions()

    def knows(self, action: str) -> bool:
        """Whether the controller has registered a function for it that is run."""
        return action in self._handlers

    def run(self, command: ClaimedCommand) -> object:
        """What the function of the command's action returns; whatever it raises is passed on.

        Raises:
            CommandRefusedError: There is no function for this action.
        """
        handler = self._handlers.get(command.action)
        if handler is None:
            raise CommandRefusedError(self._unknown(command.action))
        return self._call(handler, command)

    def _refuse(self, action: str) -> None:
        """Say once that the function is never called; a controller may register it in its loop."""
        if action in self._refused:
            return
        self._refused.add(action)
        why = (
            f"action {action!r} is built in, and the bridge runs its own: the function registered "
            f"for it is never called; choose another name, such as {'my_' + action!r}"
        )
        self._journal.log("warning", "bridge", why)
        self._recorder.errors.failed(f"register_command({action!r})", ValueError(why))

    def _unknown(self, action: str) -> str:
        """Nothing is known of a loop that looks at what get_command() returns by itself."""
        known = nearest_first(action, (*self._handlers, *BUILT_IN_ACTIONS))
        known = list(dict.fromkeys((*same_in_meaning(action, known), *known)))
        said = f"no action {action!r}; this robot knows {', '.join(known)}"
        if self._handlers:
            return said
        said += ": its controller has registered none (bridge.register_command)"
        if not self.loop_looks:
            return said
        return (
            f"{said}. get_command() returned the command; whether the loop did anything with it "
            "is not known"
        )

    def _call(self, handler: Handler, command: ClaimedCommand) -> object:
        outer, self.running = self.running, True
        try:
            with self._pause.user_code():
                return handler(command.as_dict())
        finally:
            self.running = outer


def _require_name(action: object) -> None:
    if not isinstance(action, str):
        raise TypeError(f"the name of an action is a text, not {type(action).__name__} {action!r}")
    if not 0 < len(action) <= _MOST_NAME_CHARACTERS or not action.isprintable():
        raise ValueError(
            f"action {action[:_MOST_NAME_CHARACTERS]!r} cannot be registered: choose a name of 1 "
            f"to {_MOST_NAME_CHARACTERS} printable characters"
        )
