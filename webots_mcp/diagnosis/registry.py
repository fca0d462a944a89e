"""All checks, in the order of the chain, and how they are run."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final

from webots_mcp.contract import PROJECT_DATA_FOLDER, full_path
from webots_mcp.diagnosis import (
    clients,
    machine,
    place,
    recorded,
    round_trip,
    simulation,
    simulators,
)
from webots_mcp.diagnosis.finding import Check, Checked, Finding, Subject
from webots_mcp.errors import WebotsMCPError
from webots_mcp.store.recording import Recording
from webots_mcp.transactions import is_damage, text_of

CHECKS: Final = (
    Check("Python", machine.python),
    Check("Packages", machine.packages),
    Check("SQLite", machine.sqlite),
    Check("Data folder", place.data_folder),
    Check("File system", place.file_system),
    Check("Free space", place.free_space),
    Check("Database", recorded.database),
    Check("Schema", recorded.schema),
    Check("Recording now", recorded.recording_now, needs_recording=True),
    Check("Rows", recorded.rows, needs_recording=True),
    Check("Commands", recorded.commands, needs_recording=True),
    Check("get_command", recorded.get_command, needs_recording=True),
    Check("Simulation", simulation.simulation, needs_recording=True),
    Check("Webots", simulators.installed),
    Check("Running Webots", simulators.running),
    Check("Clients", clients.clients),
)
_RECOVER: Final = (
    "stop what records there, save rows with 'sqlite3 FILE .recover', and move the file away"
)
# Starts a process of its own, which takes seconds: a server does not ask it of itself.
SERVER: Final = Check("Server", round_trip.server)


def diagnose(subject: Subject, checks: tuple[Check, ...] = CHECKS) -> list[Checked]:
    """Run the checks; what cannot be looked at says why."""
    with ExitStack() as stack:
        try:
            connection = stack.enter_context(subject.recording.reader())
            subject = replace(subject, connection=connection)
        except WebotsMCPError as error:
            subject = replace(subject, unread=error)
        return [Checked(check, _look(check, subject)) for check in checks]


def _look(check: Check, subject: Subject) -> Finding:
    """One check that fails says so, and the others go on."""
    if check.needs_recording and subject.connection is None:
        return Finding("not looked at", "there is no recording that can be read")
    try:
        return check.look(subject)
    except ModuleNotFoundError as error:
        return Finding("not looked at", f"the Python package {error.name!r} is missing")
    except Exception as error:  # noqa: BLE001  (it is told)
        if is_damage(error):
            return Finding("wrong", f"the database is damaged: {text_of(error)}", _RECOVER)
        return Finding("not looked at", f"{type(error).__name__}: {error}")


def subject_of(recording: Recording, chosen_by: str) -> Subject:
    """What is looked at of a recording: also the folder that the asker is in."""
    return Subject(replace(recording, read_only=True), chosen_by, _project(recording))


def _project(recording: Recording) -> Path:
    """The folder above `mcp_data/`, where a project's recording lies, else the current one."""
    folder = full_path(recording.data_dir)
    return folder.parent if folder.name == PROJECT_DATA_FOLDER else Path.cwd()
