"""The Webots of this machine: those that are installed, and those that run."""

from __future__ import annotations

from webots_mcp.diagnosis.finding import Finding, Subject, worst
from webots_mcp.errors import CommandRefusedError
from webots_mcp.webots.installations import Installation, find_webots, installations
from webots_mcp.webots.instances import Instance


def installed(_: Subject) -> Finding:
    """Which Webots there are."""
    found = installations()
    if found:
        return worst([_complete(each) for each in found])
    try:
        find_webots()
    except CommandRefusedError as error:
        seen, fix = str(error).rsplit(": ", 1)
        return Finding("warning", seen, fix)
    return Finding("not looked at", "it was installed while this looked")


def _complete(webots: Installation) -> Finding:
    where = webots.home or webots.program
    seen = f"{webots.version or 'a Webots without a version'} at {where} (by {webots.found_by})"
    missing = [
        name
        for name, path in (
            ("webots-controller", webots.launcher),
            ("lib/controller/python", webots.python_api),
        )
        if path is None
    ]
    if webots.home is None or not missing:
        return Finding("ok", seen)
    fix = "install Webots again, or set WEBOTS_HOME to the folder of a whole one"
    return Finding("warning", f"{seen} lacks {' and '.join(missing)}", fix)


def running(subject: Subject) -> Finding:
    """Which of them run, and whether they can be steered from outside."""
    if not subject.running_webots:
        return Finding("ok", "no Webots runs on this machine")
    return worst([_reachable(each) for each in subject.running_webots])


def _reachable(webots: Instance) -> Finding:
    world = f", {webots.world.name}" if webots.world else ""
    seen = f"port {webots.port} (process {webots.pid}{world}, mode {webots.mode or 'of its own'})"
    if not webots.is_listening:
        return Finding(
            "warning",
            f"{seen} was not seen to listen there",
            "wait until it has started; of another user's process this is not told",
        )
    obeys = "obeys" if webots.streams else "was started without --stream and does not obey"
    return Finding("ok", f"{seen} {obeys} orders from outside")
