"""What each controller of the project needs, and what a plain Robot cannot do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

from webots_mcp.contract import WORLD_ENDING, WORLD_FOLDER
from webots_mcp.database.location import find_project
from webots_mcp.errors import InvalidInputError
from webots_mcp.setup.doctor import Diagnosis, Examined, check, ok, unclear, warning, worst, wrong
from webots_mcp.setup.interpreter import Interpreter, chosen, probe_interpreter
from webots_mcp.setup.project_edits import AlreadyPatchedError, attaching_place, is_plain_robot
from webots_mcp.signals.naming import find_position
from webots_mcp.simulator.installations import installations
from webots_mcp.simulator.project import (
    NO_POSITION_OF_ITS_OWN,
    NO_SUPERVISOR,
    ProjectController,
    controllers_of,
    has_observer,
    names_a_supervisor,
    offer_observer,
    writes_states,
)
from webots_mcp.store.recording import RobotView
from webots_mcp.store.registered_signals import registered
from webots_mcp.store.robots import live_observer

_NO_PROJECT: Final = (
    "this folder is in no Webots project: run 'webots-mcp doctor' in the folder of one"
)


@check("Controllers")
def controllers(subject: Examined) -> Iterator[Diagnosis]:
    """Report which record, which need the two lines, and whose Python needs the package."""
    project = find_project(subject.project)
    if project is None:
        yield unclear(_NO_PROJECT)
        return
    findings = list(_of_each(subject, project)) or [
        ok(
            "the project has no controllers that Webots would start; the code of extern ones lies "
            "elsewhere"
        )
    ]
    seen = "; ".join(each.seen for each in findings)  # those that record are named as well
    yield replace(worst(findings), seen=seen)


def _of_each(subject: Examined, project: Path) -> Iterator[Diagnosis]:
    observed = has_observer(project)
    pythons: dict[tuple[str, ...], Interpreter] = {}
    recording = [] if subject.connection is None else subject.live
    at_work = {view.session.controller for view in recording if view.session}
    for each in controllers_of(project):
        file = each.file.relative_to(project).as_posix()
        if str(each.file) in at_work:  # and so its Python has the package
            yield ok(f"{file} records now")
        elif not each.is_python:
            yield _of_other_language(each, file, is_observed=observed)
        else:
            yield _of_lines(each.file, file, is_observed=observed)
            if subject.probes_python:
                command = chosen(each.file).command
                if command not in pythons:
                    pythons[command] = probe_interpreter(each.file)
                yield from _of_python(pythons[command], file)


def _of_lines(controller: Path, file: str, *, is_observed: bool) -> Diagnosis:
    try:
        attaching_place(controller)
    except AlreadyPatchedError:
        return ok(f"{file} has the bridge")
    except (InvalidInputError, OSError) as error:
        return unclear(f"whether {file} records is not clear: {error}")
    if is_observed:
        return ok(f"{file} has no bridge: the observer records where its robot is")
    fix = f"webots-mcp init --patch {file}"
    return warning(f"{file} does not record: it lacks the bridge's two lines", fix)


def _of_other_language(controller: ProjectController, file: str, *, is_observed: bool) -> Diagnosis:
    if writes_states(controller) or is_observed:
        return ok(f"{file} ({controller.language}) is recorded")
    return warning(f"{file} ({controller.language}) does not record", controller.advice)


def _of_python(python: Interpreter, file: str) -> Iterator[Diagnosis]:
    """Check whether Webots, where it is installed, can start the controller with the bridge."""
    if python.error is not None:
        seen = (
            f"Webots starts {file} with {python.command} ({python.chosen_by}), where the bridge "
            f"cannot be used: {python.error}"
        )
        fix = python.fix or "choose another Python in Webots' preferences"
        yield wrong(seen, fix) if installations() else warning(seen, fix)


@check("Supervisor", well="no robot was found that lacks a supervisor's rights")
def supervisor(subject: Examined) -> Iterator[Diagnosis]:
    """Report what cannot be done with a plain Robot, and that an observer would do it."""
    recording = [] if subject.connection is None else subject.live
    for view in recording:
        if view.session is not None and view.session.has_bridge and not view.session.supervisor:
            yield _of_robot(view)
    project = find_project(subject.project)
    if recording:
        return
    if project is None:
        yield unclear(_NO_PROJECT)
    elif not has_observer(project):
        yield from _of_project(project)


def _of_project(project: Path) -> Iterator[Diagnosis]:
    """Report which of its robots have no supervisor's rights, by its code, else by its worlds."""
    known = controllers_of(project)
    for each in known:
        if each.is_python and is_plain_robot(each.file):
            seen = f"the robot of {each.name} {NO_SUPERVISOR}. {NO_POSITION_OF_ITS_OWN}"
            yield warning(seen, offer_observer(project))
    for world in [] if known else sorted((project / WORLD_FOLDER).glob(f"*{WORLD_ENDING}")):
        if not names_a_supervisor(world):
            seen = f"no Robot of {world.relative_to(project)} has 'supervisor TRUE': each"
            yield warning(
                f"{seen} {NO_SUPERVISOR}. {NO_POSITION_OF_ITS_OWN}", offer_observer(project, world)
            )


def _of_robot(view: RobotView) -> Diagnosis:
    """Return what is missing for a robot that records now."""
    name = view.robot.name
    observer = live_observer(view.connection, view.session, view.now_s)
    if observer is not None:
        return ok(f"{name} is a plain Robot: {observer.name} steers, and sees where it is")
    signals = registered(view.connection, view.robot.id).values()
    has_position = find_position([each.name for each in signals if each.is_number]) is not None
    seen = f"{name} {NO_SUPERVISOR}"
    seen += "" if has_position else f". {NO_POSITION_OF_ITS_OWN}"
    world = view.run.world if view.run else None
    project = find_project(Path(world).parent) if world else None
    return warning(seen, offer_observer(project, Path(world) if world else None))
