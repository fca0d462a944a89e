"""Who may do what: the table `[allow]` of a project's `webots-mcp.toml`.

See 'webots-mcp help policy'.

    [allow]
    tools = ["*", "!webots_report"]  # the last pattern that fits decides; without one: refused
    actions = ["*", "!quit"]         # commands, built in or the controllers' own
    fields = ["BALL.*", "*.translation"]
    nodes = ["BOXES.children*"]      # where nodes may be added or removed
    worlds = ["arena*.wbt"]
    launch = false                   # or "ask"
    holds_for = "everyone"           # or "assistants"

    [allow.parameters]
    kp = [0.0, 5.0]
    gait = ["trot", "walk"]
    gain = "ask"
    "*" = true                          # as the controller declares

A pattern that begins with `?`, and the value "ask", have the person asked, where the client can
ask one. A key that is left out allows all. The file is read anew for each request, so that it holds
from the next one on, and can be neither stale nor cached.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, cast

from webots_mcp.contract import PROJECT_FILE
from webots_mcp.database.files import full_path
from webots_mcp.database.location import Database, find_project
from webots_mcp.errors import ConsentRequiredError, InvalidInputError, NotAllowedError
from webots_mcp.signals.meaning import fits_pattern
from webots_mcp.store.project_file import load_toml

ALLOW: Final = "allow"
LAUNCH: Final = "launch"  # stands for an action where Webots is started
RERUN: Final = "rerun"  # stands for an action where a controller's code is run on an old run
# The tools and commands that do an action: a rule for one of them holds for it by every route. What
# sends no such action (webots_breakpoint, webots_report, ...) is checked by its name alone.
TOOLS_OF_ACTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "pause": ("webots_simulation_control",),
    "resume": ("webots_simulation_control",),
    "fast": ("webots_simulation_control",),
    "step": ("webots_simulation_control",),
    "reset": ("webots_simulation_control", "webots_world_reset"),
    "reload": ("webots_simulation_control", "webots_world_reload"),
    "reset_state": ("webots_reset_controller_state",),
    "run": ("webots_run",),
    "cancel_run": (),  # by which nothing is done
    LAUNCH: ("webots_launch_world", "launch"),
    RERUN: ("webots_rerun_controller", RERUN),
    "load_world": ("webots_launch_world", "webots_load_world"),
    "quit": ("webots_launch_world", "webots_quit"),
    "screenshot": ("webots_take_screenshot",),
    "take_frame": ("webots_get_camera",),
    "save_world": ("webots_branch_run", "branch"),
    "record_scene": ("webots_record_scene",),
    "set_parameters": ("webots_set_parameters",),
    "arm_breakpoints": (),
    "keep": (),
    "inspect": ("webots_inspect_controller",),
    "watch": ("webots_watch",),
    "get_scene": ("webots_get_scene",),
    "get_field": ("webots_get_scene", "webots_get_field"),
    "set_field": ("webots_edit_scene", "webots_set_field"),
    "add_node": ("webots_edit_scene", "webots_add_node"),
    "remove_node": ("webots_edit_scene", "webots_remove_node"),
}
ANY_ACTION: Final = (
    "webots_send_command"  # the tool that sends any action: it stands for none of the others
)
_PATTERNS: Final = ("tools", "actions", "fields", "nodes", "worlds")
ASKS: Final = "ask"
_HOLDS_FOR: Final = ("everyone", "assistants")
# tables of the file that other modules read
_OTHER_KEYS: Final = ("expect", "signals", "inspect", "tape")
_KEYS: Final = (*_PATTERNS, "parameters", LAUNCH, "holds_for")
_ASK: Final = (
    "Do not look for another way to the same: the person whose project it is can change that line, "
    "and it holds from the next request on"
)


@dataclass(frozen=True)
class Policy:
    """What a file allows.

    Attributes:
        file: The file.
        text: The whole file, from which line numbers are derived.
        allow: Its table.
        agreed: The rules that ask the person, to which the person has agreed.
    """

    file: Path
    text: str
    allow: Mapping[str, Any]
    agreed: Collection[str] = ()

    def with_consent(self, agreed: Collection[str]) -> Policy:
        """Return the policy for a request for which the person has agreed to these rules."""
        return replace(self, agreed=agreed)

    def holds_for(self, transport: str) -> bool:
        """Return whether the policy binds callers of that transport.

        `stdio` and `http` are assistants.
        """
        everyone = self.allow.get("holds_for", _HOLDS_FOR[0]) == _HOLDS_FOR[0]
        return everyone or transport in ("stdio", "http")

    def require_tool(self, names: Sequence[str]) -> None:
        """Refuse a tool by its own name or by the name of the tool that it is a part of.

        Raises:
            NotAllowedError: The file does not allow it.
            ConsentRequiredError: It does if the person agrees.
        """
        self._require("tools", names, f"{names[0]} is not allowed")

    def require(self, action: str, params: Mapping[str, Any], asked: Sequence[str] = ()) -> None:
        """Refuse an action that the file does not allow, or does not allow with these parameters.

        Args:
            action: The action as a command names it, or `LAUNCH`.
            params: Its parameters.
            asked: The names of the tool or command that the caller used.

        Raises:
            NotAllowedError: A line of the file forbids it; the error names the line.
            ConsentRequiredError: It does if the person agrees.
        """
        self._require_route(action, asked)
        if action == LAUNCH:
            rule = self.allow.get(LAUNCH, True)
            if rule == ASKS:
                self._require_consent(LAUNCH, "Starting Webots is not allowed")
            elif not rule:
                raise self._refusal(LAUNCH, "Starting Webots is not allowed")
        # This action only has a controller read its stored breakpoints again. It is sent along with
        # every action that is allowed.
        elif action != "arm_breakpoints":
            self._require("actions", [action], f"The action {action!r:.100} is not allowed")
        if action == "run" and params.get("reset"):
            self._require_route("reset", asked)
            self._require("actions", ["reset"], "The action 'reset' is not allowed")
        for brought_about in _brought_about(action, params):
            self._require_route(brought_about, asked)
            self._require_not_forbidden(brought_about, action)
        if action in (LAUNCH, "load_world"):
            self._require_world(params.get("world"))
        if action == "set_field":
            path = str(params.get("path"))
            self._require("fields", [path.strip()], f"Setting {path!r:.100} is not allowed")
        if action in ("add_node", "remove_node"):
            path = str(params.get("path") or "root")
            doing = "Adding to" if action == "add_node" else "Removing"
            self._require("nodes", [path.strip()], f"{doing} {path!r:.100} is not allowed")
        if (values := params.get("values" if action == "set_parameters" else "parameters")) and (
            action in ("set_parameters", "run", LAUNCH)
        ):
            self._require_values(values)

    def _require_not_forbidden(self, brought_about: str, action: str) -> None:
        """Refuse an action if a pattern forbids another action that it causes."""
        patterns = cast("list[str]", self.allow.get("actions", []))
        if any(fits_pattern(_bare(each), brought_about) for each in patterns):
            said = f"{brought_about!r}, which this {action!r:.100} does as well, is not allowed"
            self._require("actions", [brought_about], said)

    def _require_route(self, action: str, asked: Sequence[str]) -> None:
        """Refuse what the tools of an action may not do, whichever tool requested it."""
        tools = TOOLS_OF_ACTIONS.get(action, ())
        patterns = cast("list[str]", self.allow.get("tools", []))
        is_named = any(fits_pattern(_bare(p), tool) for p in patterns for tool in tools)
        if tools and (is_named or ANY_ACTION in asked):
            by = f"{action!r:.100}, which {tools[-1]} does, is not allowed"
            self._require("tools", tools, by)

    def _require_world(self, world: object) -> None:
        """Check a world by its path from the project or its folder of worlds, links resolved."""
        if "worlds" not in self.allow:
            return
        given = Path(str(world))
        # a controller would load it from another folder than this process
        if not given.is_absolute():
            said = f"{str(world)!r:.100} is no full path of a world, and so not allowed"
            raise self._refusal("worlds", said)
        try:
            file = full_path(given)
        except OSError:
            file = given
        project = (find_project(self.file.parent) or self.file.parent).resolve()
        folders = [project / "worlds", project]
        names = [file.relative_to(each).as_posix() for each in folders if file.is_relative_to(each)]
        self._require("worlds", [*names, file.as_posix()], f"The world {file} is not allowed")

    def _require_values(self, values: object) -> None:
        rules = cast("dict[str, Any] | None", self.allow.get("parameters"))
        if rules is None:
            return
        if not isinstance(values, Mapping):
            raise self._refusal("parameters", "Parameters without names are not allowed")
        for name, value in cast("Mapping[str, object]", values).items():
            key = name if name in rules else next((k for k in rules if fits_pattern(k, name)), None)
            if key is None:
                raise self._refusal("parameters", f"The parameter {name!r:.100} is not allowed")
            said = f"The value {value!r:.100} of parameter {name!r:.100} is not allowed"
            if rules[key] == ASKS:
                self._require_consent("parameters", said, key)
            elif not _is_within(value, rules[key]):
                raise self._refusal("parameters", said, key)

    def _require(self, key: str, names: Sequence[str], said: str) -> None:
        """Apply the last pattern that matches one of the names."""
        patterns = cast("list[str] | None", self.allow.get(key))
        if patterns is None:
            return
        fitting = [p for p in patterns if any(fits_pattern(_bare(p), name) for name in names)]
        if not fitting or fitting[-1].startswith("!"):
            raise self._refusal(key, said, fitting[-1] if fitting else None)
        if fitting[-1].startswith("?"):
            self._require_consent(key, said, fitting[-1])

    def _refusal(self, key: str, said: str, inside: str | None = None) -> NotAllowedError:
        rule = self._rule(key, inside)
        return NotAllowedError(f"{said} by {rule}. {_ASK}", rule)

    def _require_consent(self, key: str, said: str, inside: str | None = None) -> None:
        """Refuse what the person has not agreed to."""
        rule = self._rule(key, inside)
        if rule not in self.agreed:
            asks = f"{said} without the consent of the person, by {rule}. {_ASK}"
            raise ConsentRequiredError(asks, rule)

    def _rule(self, key: str, inside: str | None) -> str:
        """Return the file, the line and the text of a rule."""
        line = line_of(self.text, key, inside)
        shown = self.text.splitlines()[line - 1].partition("#")[0].strip()
        return f"{self.file}, line {line}: {shown:.200}"


def _bare(pattern: str) -> str:
    """Return a pattern without the mark for forbidding or asking."""
    return pattern[1:] if pattern[:1] in ("!", "?") else pattern


def _brought_about(action: str, params: Mapping[str, Any]) -> Iterator[str]:
    """Return the other actions whose effect an action has, because a rule against one forbids it.

    A run with `reset` is not among them: it needs both to be allowed.
    """
    is_run = action == "run"
    if (is_run or action == LAUNCH) and params.get("parameters"):
        yield "set_parameters"
    if action == "step" or (is_run and params.get("then", "pause") == "pause"):
        yield "pause"
    if is_run and params.get("pace") == "fast":
        yield "fast"
    if is_run and params.get("then") == "go_on":
        yield "resume"


def _is_within(value: object, rule: Any) -> bool:
    if isinstance(rule, bool):
        return rule
    if isinstance(rule[0], str):
        return value in rule
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and rule[0] <= cast("float", value) <= rule[1]  # NaN lies within no range


def line_of(text: str, key: str, inside: str | None = None) -> int:
    """Return the line of a key of the table, or of a name or text within it; from 1."""
    lines, table, found = text.splitlines(), "", 1
    parts = [re.escape(key)] + ([re.escape(inside)] if inside else [])
    for number, line in enumerate(lines, 1):
        if header := re.match(r"\s*\[{1,2}\s*([^\]]+?)\s*\]", line):
            table = header[1].replace('"', "").replace(" ", "")
        own = table == ALLOW and re.match(rf"\s*[\"']?{parts[0]}[\"']?\s*[=.]", line)
        if own or table == f"{ALLOW}.{key}":
            found = number if own or found == 1 else found
            if inside is None:
                return found
        if found > 1 and re.search(rf"(?<![\w.]){parts[-1]}(?![\w.])", line.partition("#")[0]):
            return number
    return found


def policies_of(database: Database, data_dir: Path, files: Iterable[str]) -> Iterator[Policy]:
    """Return the policies of each `webots-mcp.toml` in or above the folders of a request.

    All apply.

    The file of the project is not enough: creating folders inside a project changes which folder is
    the project.

    Args:
        database: The recording; the file next to it applies wherever its pictures are.
        data_dir: The folder of its pictures.
        files: The world that is started or opened, and the worlds of running simulations with their
            controllers, which may belong to other projects.

    Raises:
        NotAllowedError: A file is invalid; nothing is allowed until it is corrected.
    """
    below = [database.parent] if isinstance(database, Path) else []
    below += [data_dir, *(Path(each).parent for each in files)]
    folders = (folder for each in below for folder in (each, *each.parents))
    for folder in dict.fromkeys(folders):
        file = folder / PROJECT_FILE
        if os.path.lexists(file) and (policy := read_policy(file)) is not None:
            yield policy


def is_named(policies: Iterable[Policy], action: str) -> bool:
    """Return whether a file allows an action by its name and not by a pattern."""
    return any(action in policy.allow.get("actions", ()) for policy in policies)


def read_policy(file: Path) -> Policy | None:
    """Return what a project's file allows; None if it has no such table.

    Raises:
        NotAllowedError: The file is invalid; the error names the line and the reason.
    """
    try:
        text, content = load_toml(file)
        if unknown := sorted(set(content) - {ALLOW, *_OTHER_KEYS}):
            raise InvalidInputError(
                f"{file}: unknown table {unknown[0]!r}. Tables: allow, expect, signals, inspect"
            )
        if ALLOW not in content:
            return None
        if (wrong := next(_faults(content[ALLOW]), None)) is not None:
            key, why = wrong
            raise InvalidInputError(f"{file}, line {line_of(text, key)}: {why}")
    except InvalidInputError as error:
        raise NotAllowedError(
            f"{error}. While that file is invalid, nothing may be changed; recording "
            "and reading go on. "
            "The person whose project it is has to correct it.",
            str(error),
        ) from error
    return Policy(file, text, content[ALLOW])


def _faults(allow: Any) -> Iterator[tuple[str, str]]:
    """Yield the faults of the table: key and reason."""
    if not isinstance(allow, dict):
        yield ALLOW, "allow must be a table: [allow]"
        return
    reason = "put the patterns with ? before the others"
    for key, value in cast("dict[str, Any]", allow).items():
        if key not in _KEYS:
            yield key, f"allow.{key} is unknown; there is {', '.join(_KEYS)}"
        elif key in _PATTERNS and not _is_list_of(str, value):
            yield key, f"{key} must be a list of texts, not {value!r:.80}"
        elif key in ("fields", "nodes") and any(each.startswith("!") for each in value):
            yield key, f"{key} cannot forbid, as a node has many names: list what is allowed"
        elif key in ("fields", "nodes") and _asks_behind_what_is_allowed(value):
            yield (
                key,
                f"{key} must ask first and allow then, as a node has many names: {reason}",
            )
        elif key == LAUNCH and not (isinstance(value, bool) or value == ASKS):
            yield key, f'launch must be true, false or "ask", not {value!r:.80}'
        elif key == "holds_for" and value not in _HOLDS_FOR:
            yield key, f"holds_for must be one of {', '.join(_HOLDS_FOR)}, not {value!r:.80}"
        elif key == "parameters":
            yield from _faults_of_parameters(value)


def _faults_of_parameters(rules: Any) -> Iterator[tuple[str, str]]:
    if not isinstance(rules, dict):
        yield "parameters", "parameters must be a table: [allow.parameters]"
        return
    for name, rule in cast("dict[str, Any]", rules).items():
        is_range = _is_list_of((int, float), rule) and len(rule) == 2 and rule[0] <= rule[1]
        is_finite = is_range and not any(isinstance(x, bool) or math.isnan(x) for x in rule)
        is_known = isinstance(rule, bool) or rule == ASKS
        if not (is_known or is_finite or (rule and _is_list_of(str, rule))):
            yield (
                "parameters",
                f'{name} must be [lowest, highest], a list of texts, true, false or "ask", not '
                f"{rule!r:.80}",
            )


def _asks_behind_what_is_allowed(patterns: Sequence[str]) -> bool:
    """Return whether a name that asks, other than the allowed one, could match what is allowed."""
    marks = [pattern.startswith("?") for pattern in patterns]
    return marks != sorted(marks, reverse=True)


def _is_list_of(kind: Any, value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(each, kind) for each in cast("Iterable[Any]", value)
    )
