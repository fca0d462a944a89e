"""Define the command that runs new code on an old run, also in a debugger."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from webots_mcp.cli.options import HERE, Id, Json, Parameter, Where
from webots_mcp.errors import InvalidInputError


def rerun(
    run_id: Annotated[
        Id | None, Parameter("RUN", help="Run number. Default: the newest run with a tape.")
    ] = None,
    file: Annotated[
        Path | None,
        Parameter(
            "FILE", help="Controller file to run. Default: the run's controller as it is now."
        ),
    ] = None,
    /,
    *,
    until_s: Annotated[
        float | None,
        Parameter("--until", metavar="S", help="Stop at this simulation time of the run."),
    ] = None,
    pdb: Annotated[
        bool,
        Parameter(
            "--pdb",
            negative=(),
            help="Debug the file in this terminal, from the first difference on.",
        ),
    ] = False,
    break_at_s: Annotated[
        float | None,
        Parameter(
            "--break-at",
            metavar="S",
            help="With --pdb: begin to debug at this simulation time instead.",
        ),
    ] = None,
    trust: Annotated[
        bool,
        Parameter(
            "--trust",
            negative=(),
            help="Run the code of an imported run, which came from elsewhere.",
        ),
    ] = False,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Run new code on the tape of an old run, and report when it first commands something else.

        webots-mcp rerun 12 controllers/rover/rover.py

    First the recorded code is replayed, which must repeat itself. Then the file is, and the answer
    names the first difference and the line that decided. No simulator is needed. The script's side
    effects, such as files that it writes, are real.

    To record a tape, start with 'webots-mcp launch WORLD --tape'. To debug at 12.4 s of the run:

        webots-mcp rerun 12 --pdb --break-at 12.4
    """
    from webots_mcp.cli.question_commands import ask_and_show
    from webots_mcp.questions.rerun_controller import webots_rerun_controller

    if break_at_s is not None and not pdb:
        raise InvalidInputError("--break-at applies only to --pdb. Add --pdb, or leave it out.")
    if pdb and json:
        raise InvalidInputError("--pdb talks with a person and cannot answer as JSON.")
    if pdb:
        return _debug(run_id, file, until_s, break_at_s, recorded, trust=trust)
    asked: dict[str, Any] = {"run_id": run_id, "file": str(file) if file else None}
    asked |= {"until_s": until_s, "trust": trust or None}
    ask_and_show(webots_rerun_controller, asked, recorded, as_json=json)


def _debug(
    run_id: int | None,
    file: Path | None,
    until_s: float | None,
    break_at_s: float | None,
    recorded: Where,
    *,
    trust: bool,
) -> None:
    from webots_mcp.questions import rerun_controller
    from webots_mcp.rerun import running
    from webots_mcp.store.policy import RERUN
    from webots_mcp.store.requests import BY_COMMAND_LINE, OpenRequest, permit

    recording = recorded.recording()
    names = ("webots_rerun_controller", RERUN)
    named = str(file) if file else None
    asked = {"run_id": run_id, "file": named}
    with OpenRequest(recording, BY_COMMAND_LINE, names, asked):
        permit(recording, RERUN, asked)
        taped = rerun_controller.taped_run(recording, run_id)
        running.require_own_tape(taped, trusted=trust)
        own = rerun_controller.file_of(taped, named, recording)
        first = None
        if break_at_s is None:
            found = running.rerun(taped, own, until_s=until_s)
            print(found.text)
            first = found.rounds if found.outcome == "differs" else None
        running.debug(taped, own, until_s=until_s, break_at_s=break_at_s, break_round=first)
