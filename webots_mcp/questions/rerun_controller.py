"""The question what new code would have commanded on an old run: a replay of its tape."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from webots_mcp.answers.answer_models import RerunAnswer
from webots_mcp.database.location import find_project
from webots_mcp.errors import NotAllowedError
from webots_mcp.questions.arguments import MAX_WAIT_S, RunId, Seconds
from webots_mcp.questions.declaration import DESTROYS, Caller, question
from webots_mcp.store.policy import RERUN, is_named, policies_of
from webots_mcp.store.recording import RecordingAccess
from webots_mcp.store.requests import permit

if TYPE_CHECKING:
    from webots_mcp.rerun.running import TapedRun

_REPLAYS: Final = (
    4  # of the old and the new version, and once more of each in the round that differs
)


@question(
    "Run new code on an old run",
    DESTROYS,  # a script may write and delete files
    command="rerun",
    positional=("run_id", "file"),
    options={"until_s": "--until"},
    example="12 controllers/rover/rover.py",
    quotes=True,
    tier="all",
)
def webots_rerun_controller(
    recording: RecordingAccess,
    caller: Caller,
    run_id: RunId = None,
    file: Annotated[
        str | None,
        Field(
            max_length=4096,
            description="Controller file to run, in the project. Default: the controller of the "
            "run, as it is now.",
        ),
    ] = None,
    until_s: Annotated[
        Seconds | None,
        Field(description="Simulation time of the run at which to stop. Default: its end."),
    ] = None,
    trust: SkipJsonSchema[bool] = False,
) -> RerunAnswer:
    """Find out what an edited Python controller would have commanded in a recorded run.

    Replays the run's tape without a simulator: first the recorded code, which must repeat itself,
    then the new one. Answers at which simulation time a command first differs, and which line
    decided; nothing is known after that. Needs a run recorded with `webots-mcp launch --tape`, or
    one whose rows hold each step and all that the code reads. The script runs with all its side
    effects. To compare two recorded runs use webots_compare_runs.
    """
    from webots_mcp.rerun.running import LIMIT_S, require_own_tape, rerun

    require_rerun(recording, caller, file)
    taped = taped_run(recording, run_id)
    require_own_tape(taped, trusted=trust and caller.client == "cli")
    limit_s = LIMIT_S if caller.client == "cli" else MAX_WAIT_S / _REPLAYS
    found = rerun(taped, file_of(taped, file, recording), until_s=until_s, limit_s=limit_s)
    line = found.deciding_line or {}
    return RerunAnswer(
        run_id=found.run_id,
        verdict=found.text,
        comparison=found.outcome,
        equal_rounds=found.rounds,
        equal_until_s=found.until_s,
        of_rounds=found.of_rounds,
        differences=found.first_differences or None,
        deciding_line={name: value for name, value in line.items() if value} or None,
        not_recorded=found.unrecorded,
        likely_causes=found.likely_causes or None,
        exception=found.exception,
        place=found.place,
        file=found.file,
        basis=found.basis,
        hint=_hint(found.began_late),
    )


def _hint(began_late: bool) -> str | None:
    if not began_late:
        return None
    return (
        "The tape began after the robot was made, so what was asked before is missing: set "
        "WEBOTS_MCP_TAPE=1 or 'tape = true' in webots-mcp.toml."
    )


def require_rerun(recording: RecordingAccess, caller: Caller, file: str | None) -> None:
    """Refuse to run code where the project's file does not allow it, or a client over HTTP asks.

    Raises:
        NotAllowedError: Which line does not allow it, or which one would.
    """
    permit(recording, RERUN, {"file": file})
    if caller.by.transport == "http":
        policies = policies_of(recording.database, recording.data_dir, ())
        if not is_named(policies, RERUN):
            raise NotAllowedError(
                "A client over HTTP may not run code of the project, unless webots-mcp.toml names "
                f'the action: actions = ["*", "{RERUN}"] under [allow].',
                RERUN,
            )


def taped_run(recording: RecordingAccess, run_id: int | None) -> TapedRun:
    """Return a run and its tape, or one made of its rows; by default the newest one with a tape.

    Raises:
        NothingRecordedError: It has no tape, and its rows do not suffice.
    """
    from webots_mcp.rerun.running import find_taped_run, newest_run

    place = (recording.database, recording.data_dir)
    return find_taped_run(*place, newest_run(*place) if run_id is None else run_id)


def file_of(taped: TapedRun, file: str | None, recording: RecordingAccess) -> Path:
    """Return the version to run: a file of the project, by default the controller as it is now.

    Raises:
        InvalidInputError: It is missing, is not Python, or lies outside of the project.
    """
    from webots_mcp.rerun.running import current_file, require_own

    if file is None:
        return current_file(taped)
    head: dict[str, Any] = taped.tape.head
    project = find_project(recording.data_dir) or Path(head["project"])
    found = (Path.cwd() / file, project / file)
    given = next((each for each in found if each.is_file()), found[0])
    return require_own(given, project)
