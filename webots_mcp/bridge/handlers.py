"""The custom actions: functions of the controller that an assistant may call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from webots_mcp.bridge.command_queue import ClaimedCommand
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
        running: A function is being called: the present call comes from within it.
        loop_polls: The loop itself calls `get_command()`, and may handle the command it returns.
    """

    def __init__(self, recorder: Recorder, journal: Journal, pause: Pause) -> None:
        self._recorder = recorder
        self._journal = journal
        self._pause = pause
        self._handlers: dict[str, Handler] = {}
        self._refused: set[str] = set()
        self.running = False
        self.loop_polls = True

    def register(self, action: str, handler: Handler) -> None:
        """Register a custom action, here and in the session's row.

        A built-in action cannot be replaced, except for `reset_state`, which calls functions of the
        controller anyway.

        Raises:
            ValueError: The name is empty, too long, or not printable.
            TypeError: The name is not a text, or the handler is not a plain function.
        """
        _require_name(action)
        built_in = BUILT_IN_ACTIONS.get(action)
        if built_in is not None and not built_in.runs_user_code:
            self._refuse(action)
            return
        import inspect  # only here: it would be a fifth of the bridge's import time

        if not callable(handler) or inspect.iscoroutinefunction(handler):
            raise TypeError(f"the handler of {action!r} must be a plain function, not {handler!r}")
        docstring = getattr(handler, "__doc__", None)
        doc = inspect.cleandoc(docstring) if isinstance(docstring, str) else ""
        if built_in is not None and action not in self._handlers:
            why = "this function is called instead of the callbacks of on_reload()"
            self._journal.log("info", "bridge", f"the controller has registered {action!r}: {why}")
        self._handlers[action] = handler
        self._recorder.session.actions[action] = storable(cut(doc, _MOST_DOC_CHARACTERS))
        self._recorder.update_actions()

    def knows(self, action: str) -> bool:
        """Whether the controller has registered a function for the action."""
        return action in self._handlers

    def run(self, command: ClaimedCommand) -> object:
        """Call the function of the command's action; whatever it raises is passed on.

        Raises:
            CommandRefusedError: There is no function for this action.
        """
        handler = self._handlers.get(command.action)
        if handler is None:
            raise CommandRefusedError(self._unknown(command.action))
        return self._call(handler, command)

    def _refuse(self, action: str) -> None:
        """Warn once that the function is never called; a loop may register it in every round."""
        if action in self._refused:
            return
        self._refused.add(action)
        why = (
            f"action {action!r} is built in and cannot be replaced: the function registered for it "
            f"is never called; choose another name, such as {'my_' + action!r}"
        )
        self._journal.log("warning", "bridge", why)
        self._recorder.errors.failed(f"register_command({action!r})", ValueError(why))

    def _unknown(self, action: str) -> str:
        """The error of a command whose action is neither built in nor registered."""
        known = nearest_first(action, (*self._handlers, *BUILT_IN_ACTIONS))
        known = list(dict.fromkeys((*same_in_meaning(action, known), *known)))
        text = f"no action {action!r}; this robot has {', '.join(known)}"
        if self._handlers:
            return text
        text += ": its controller has registered none (bridge.register_command)"
        if not self.loop_polls:
            return text
        return (
            f"{text}. get_command() returned the command to the loop; the bridge does not know "
            "whether the loop handled it"
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
        kind = type(action).__name__
        raise TypeError(f"the name of an action must be a text, not {kind} {action!r}")
    if not 0 < len(action) <= _MOST_NAME_CHARACTERS or not action.isprintable():
        raise ValueError(
            f"action {action[:_MOST_NAME_CHARACTERS]!r} cannot be registered: choose a name of 1 "
            f"to {_MOST_NAME_CHARACTERS} printable characters"
        )
