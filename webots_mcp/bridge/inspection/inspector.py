"""Records the controller's own variables at hits, violations, errors and hangs, and shows them.

An inspection is an event of the kind `inspection`: for each of the controller's own frames its
file, line, source and local variables. Only what is alive at that moment is seen. Before Python
3.13 reading the variables of a frame may keep their objects alive until it is read again.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from types import FrameType, ModuleType, TracebackType
from typing import Any, Final

from webots_mcp.bridge.error_report import ErrorReport, cut
from webots_mcp.bridge.inspection.attribute_paths import (
    PathEndsError,
    find_root,
    follow,
)
from webots_mcp.bridge.inspection.frames import (
    OwnFrame,
    SourceLines,
    frames_of_error,
    own_frames,
)
from webots_mcp.bridge.inspection.objects import class_of, has_base, own_text
from webots_mcp.bridge.inspection.values import Renderer, signal_value
from webots_mcp.bridge.journal import Journal
from webots_mcp.bridge.simulation import Clock
from webots_mcp.contract import INSPECTION_EVENT
from webots_mcp.database.secret_names import SecretNames, read_secret_names
from webots_mcp.database.variable_paths import AttributePath, parse_path
from webots_mcp.errors import CommandRefusedError, InvalidInputError

MOST_INSPECTIONS: Final = 20  # of one cause in a run
_MOST_VARIABLES: Final = 40  # of one frame
_LONGEST_CAUSE: Final = 200
_LONGEST_NAME: Final = 120  # of a function or a file
_DEPTH: Final = 2  # an object and its attributes; a list and its items
_DEPTH_OF_PATH: Final = 3
_ANSWER_CHARACTERS: Final = 5_000
_CHANGED: Final = "another thread changed it meanwhile ({}): ask again"
_NOT_RECORDED: Final = (
    "only this text is recorded, not the contents: watch a number, text or short list in it"
)
_TRACEBACK: Final[Any] = vars(BaseException)["__traceback__"]


class Inspector:
    """Reads the frames of a loop.

    Args:
        data_dir: The recording's folder, whose project may name more secrets.
        started_s: When the controller had started, in Unix time.
    """

    def __init__(
        self,
        clock: Clock,
        journal: Journal,
        errors: ErrorReport,
        data_dir: Path,
        started_s: float,
    ) -> None:
        self._clock = clock
        self._journal = journal
        self._errors = errors
        self._data_dir = data_dir
        self._run = clock.run
        self._counts: Counter[tuple[str, object]] = Counter()
        self._started_s = started_s
        self._source: SourceLines | None = None
        self._secrets: SecretNames | None = None
        self.off: str | None = None  # why nothing is inspected

    # -- recording -----------------------------------------------------------------------------

    def record(self, cause: str, name: str, key: object, frame: FrameType | None) -> None:
        """Record the variables of a frame and its callers, the first 20 times of a cause in a run.

        Args:
            cause: `breakpoint`, `violation`, `error` or `hang`.
            name: What happened.
            key: What is counted: a breakpoint, for example.
            frame: Where it happened; the controller's own frames are found from there.
        """
        if self._is_wanted(cause, key):
            error = sys.exc_info()[1] if cause == "error" else None
            raised = frames_of_error(_traceback_of(error)) if error is not None else []
            known = {id(each.frame) for each in raised}
            callers = [each for each in own_frames(frame) if id(each.frame) not in known]
            self._record(cause, name, [*raised, *callers])

    def prepare(self) -> None:
        """Read what the project says of secrets."""
        self._read_secrets()

    def record_error(self, error: BaseException, name: str) -> None:
        """Record the variables where an exception was raised that ends the controller."""
        if self._is_wanted("error", "uncaught"):
            self._record("error", name, frames_of_error(_traceback_of(error)))

    def _is_wanted(self, cause: str, key: object) -> bool:
        if self._clock.run is not self._run:
            self._run = self._clock.run
            self._counts.clear()
        self._counts[cause, key] += 1
        return self._counts[cause, key] <= MOST_INSPECTIONS and self._read_secrets() is not None

    def _record(self, cause: str, name: str, frames: list[OwnFrame]) -> None:
        try:
            shown = self._shown_frames(frames)
        except RuntimeError:  # another thread changes a container: it would be incomplete
            return
        if shown:
            data: dict[str, object] = {"cause": cause, "frames": shown}
            self._journal.event(INSPECTION_EVENT, data, cut(name, _LONGEST_CAUSE))

    # -- answering -----------------------------------------------------------------------------

    def show(self, path: object, frame: FrameType | None) -> dict[str, object]:
        """Return the frames of the loop, or the value at a path.

        Raises:
            InvalidInputError: The path is invalid, or inspection is switched off.
            CommandRefusedError: The path ends before its end.
        """
        secrets = self.secrets()
        frames = own_frames(frame)
        try:
            if path is None:
                return {"frames": self._shown_frames(frames, _ANSWER_CHARACTERS)}
            parsed = parse_path(path, secrets)
            value = _value_at(parsed, frames)
            renderer = Renderer(secrets, _ANSWER_CHARACTERS)
            where = self._place(frames[0]) if frames else {}
            return {
                "path": parsed.text,
                "value": renderer.render(value, _DEPTH_OF_PATH, parsed.text),
                **where,
            }
        except (RuntimeError, LookupError) as error:
            raise CommandRefusedError(_CHANGED.format(error)) from error

    def signal(self, path: AttributePath, frame: FrameType | None) -> dict[str, object]:
        """Return the value at a path as it would be recorded.

        Raises:
            CommandRefusedError: The path ends before its end.
        """
        value = _value_at(path, own_frames(frame))
        recorded = signal_value(value)
        if class_of(recorded) is str and class_of(value) is not str and recorded[0] == "<":
            return {"value": recorded, "note": _NOT_RECORDED}
        return {"value": recorded}

    def secrets(self) -> SecretNames:
        """Return the names whose values are left out.

        Raises:
            InvalidInputError: Inspection is switched off, and by what.
        """
        secrets = self._read_secrets()
        if secrets is None:
            raise InvalidInputError(self.off or "inspection is switched off")
        return secrets

    def _read_secrets(self) -> SecretNames | None:
        """Read the names of secrets once; None where inspection is switched off."""
        if self._secrets is None and self.off is None:
            try:
                self._secrets = read_secret_names(self._data_dir)
            except (InvalidInputError, OSError, ValueError) as error:
                self.off = str(error)
                if not isinstance(error, InvalidInputError):
                    self._errors.failed("inspection", error)
        return self._secrets

    # -- frames --------------------------------------------------------------------------------

    def _shown_frames(
        self, frames: list[OwnFrame], characters: int | None = None
    ) -> list[dict[str, object]]:
        secrets = self.secrets()
        renderer = Renderer(secrets, characters) if characters else Renderer(secrets)
        shown: list[dict[str, object]] = []
        for own in frames:
            place = self._place(own, with_source=not renderer.is_full)
            renderer.spend(sum(map(len, map(str, place.values()))))
            shown.append({**place, "variables": self._variables(own, renderer)})
        return shown

    def _place(self, own: OwnFrame, *, with_source: bool = True) -> dict[str, object]:
        code = own.frame.f_code
        place: dict[str, object] = {
            "at": f"{Path(code.co_filename).name[-_LONGEST_NAME:]}:{own.line}",
            "function": own_text(code.co_name)[:_LONGEST_NAME],
        }
        if not with_source:
            return place
        if self._source is None:
            self._source = SourceLines(self._started_s, self.secrets())
        source = self._source.around(own)
        return {**place, "source": source} if source else place

    def _variables(self, own: OwnFrame, renderer: Renderer) -> dict[str, Any]:
        names = list(own.variables.items())
        if own.frame.f_code.co_name == "<module>":
            names = [
                (name, value)
                for name, value in names
                if not (name.startswith("__") or _is_definition(value))
            ]
        shown = renderer.members(names[:_MOST_VARIABLES], _DEPTH)
        return {**shown, "...": f"{len(names)} in all"} if len(names) > len(shown) else shown


def _value_at(path: AttributePath, frames: list[OwnFrame]) -> Any:
    try:
        return follow(path, find_root(path, frames))
    except PathEndsError as error:
        raise CommandRefusedError(f"{path.text}: {error}") from error
    except (RuntimeError, LookupError) as error:
        raise CommandRefusedError(_CHANGED.format(error)) from error


def _traceback_of(error: BaseException) -> TracebackType | None:
    """Return the traceback of an error, whose class may define a property of that name."""
    return _TRACEBACK.__get__(error)


def _is_definition(value: object) -> bool:
    """Return whether a name of a module is an import, a class or a function."""
    kind = id(type(value))
    return kind in _DEFINITIONS or has_base(type(value), type)


_DEFINITIONS: Final = frozenset(map(id, (ModuleType, type(_is_definition), type(len))))
