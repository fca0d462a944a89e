"""What is known of a simulation before it is steered, and the evidence afterwards that it obeyed.

Both are read from the recording, and from the list of the Webots that run on this machine.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import NamedTuple

from webots_mcp.contract import HEARTBEAT_LATE_S, UNMOVED
from webots_mcp.errors import (
    AmbiguousRobotError,
    CommandRefusedError,
    NoDatabaseError,
    NothingRecordedError,
)
from webots_mcp.simulator.instances import Instance, instance_at, instances
from webots_mcp.simulator.orders import Order, WebotsAddress, address_of
from webots_mcp.simulator.own_webots import belongs
from webots_mcp.steering.target_robot import find_target
from webots_mcp.store.loop_evidence import find_holder
from webots_mcp.store.recording import RecordingAccess, RobotView, view_robot
from webots_mcp.store.robots import list_robots, live_observer
from webots_mcp.store.sessions import SessionRecord


class RecordedUntil(NamedTuple):
    """The newest moment of the recording before an order; later rows show its effect."""

    run_id: int | None
    sim_time_s: float | None


@dataclass
class Situation:
    """What is known before the first route is tried.

    Attributes:
        robot: The recorded name of the robot; None where none is recorded.
        can_command: Whether a command can be queued for its controller.
        why_silent: Why a command would wait now; None where the controller's loop runs.
        address: Webots' address as named by the caller or by the robot's session.
        before: The newest moment of its recording.
        observer: The name of the live observer of its simulation, if there is one.
        is_address_sure: Whether the wanted Webots certainly listens at the address: the caller has
            named it, or a live controller runs there. Otherwise another Webots may listen by now.
    """

    robot: str | None
    can_command: bool
    why_silent: str | None
    address: WebotsAddress | None
    before: RecordedUntil
    observer: str | None = None
    is_address_sure: bool = False

    @staticmethod
    def without_controller(
        why: str, address: WebotsAddress | None = None, *, is_address_sure: bool = False
    ) -> Situation:
        """Return the situation in which no recorded robot can be asked."""
        until = RecordedUntil(None, None)
        return Situation(None, False, why, address, until, is_address_sure=is_address_sure)


def assess(recording: RecordingAccess, robot: str | None, action: str) -> Situation:
    """Find out which controllers could run an action that steers the simulation.

    Raises:
        InvalidInputError: There is no such robot, or several are possible.
        CommandRefusedError: Another robot's bridge has paused the simulation.
    """
    try:
        with recording.reader() as connection:
            try:
                view = find_target(connection, robot, action)
            except AmbiguousRobotError:
                if any(known.live for known in list_robots(connection, time.time())):
                    raise
                return Situation.without_controller(
                    "none of the recorded robots has a live controller"
                )
            except CommandRefusedError as error:
                view = view_robot(connection, robot)
                _require_not_held_elsewhere(view, error)
                return _situation(view, can_command=False, why_silent=str(error))
            return _situation(view, can_command=True, why_silent=_why_silent(view))
    except (NoDatabaseError, NothingRecordedError) as error:  # their texts say how to record
        return Situation.without_controller(str(error).rstrip("."))


def find_evidence(order: Order, before: RecordedUntil, view: RobotView) -> str | None:
    """Return the evidence in the recording that an order was obeyed; None while there is none."""
    if order == "pause":
        unknown = view.status.is_moving or view.status.why == UNMOVED
        return None if unknown else f"status: {view.status.text}"
    if order in ("resume", "fast", "step"):
        now_s = view.header()["sim_time_s"]
        if now_s is not None and (before.sim_time_s is None or now_s > before.sim_time_s):
            return f"simulation time advanced to {now_s} s"
    if view.run is None or view.run.id == before.run_id:
        return None
    return f"run {view.run.id} began"


def find_address(recording: RecordingAccess, situation: Situation) -> WebotsAddress:
    """Find the address of the wanted Webots; if unknown, that of the only one of this project.

    Raises:
        CommandRefusedError: There is none, or several, or only those of others.
    """
    address = situation.address
    if address is not None and situation.is_address_sure:
        return address
    running = instances()
    if address is not None and not running:  # the system may not list its processes
        return address
    ours = [found for found in running if belongs(found, recording)]
    same = [found for found in ours if found.address == address]
    return _require_one(same or ours, running).address


def find_instance(recording: RecordingAccess, situation: Situation) -> Instance:
    """Find the wanted Webots among the programs of this machine.

    Raises:
        CommandRefusedError: It runs on another machine, or it is not clear which one is wanted.
    """
    address = find_address(recording, situation)
    found = instance_at(address.port)
    if found is not None and found.address == address:  # another machine may use the same port
        return found
    raise CommandRefusedError(f"No Webots of this machine listens at {address}")


def _require_not_held_elsewhere(view: RobotView, error: CommandRefusedError) -> None:
    """Refuse a simulation that another robot's bridge has paused: only that bridge resumes it."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return
    holder = find_holder(view.connection, session, view.now_s)
    if holder is None or holder.id == session.id:
        return
    observer = live_observer(view.connection, session, view.now_s)
    if observer is None or observer.id != holder.robot_id:
        raise error


def _situation(view: RobotView, *, can_command: bool, why_silent: str | None) -> Situation:
    observer = live_observer(view.connection, view.session, view.now_s)
    return Situation(
        robot=view.robot.name,
        can_command=can_command,
        why_silent=why_silent,
        address=address_of(view.session.instance) if view.session else None,
        before=RecordedUntil(view.run.id if view.run else None, view.header()["sim_time_s"]),
        observer=observer.name if observer else None,
        is_address_sure=view.robot.live,
    )


def _why_silent(view: RobotView) -> str | None:
    """Say why a command would not be claimed soon; None where it would, or this is unknown."""
    session = view.session
    if session is None or not session.is_alive(view.now_s):
        return None  # it is being reloaded
    if not session.heartbeat_is_fresh(view.now_s):
        return view.status.why or "the controller's loop is silent"
    if _never_polls(session, view.now_s):
        return "the controller's loop does not call bridge.get_command()"
    return None


def _never_polls(session: SessionRecord, now_s: float) -> bool:
    """Return whether the loop has run for two heartbeats without calling `get_command()`."""
    since_s = session.last_poll_wall_time_s or session.started_wall_time_s
    return session.age_s(since_s, now_s) > 2 * HEARTBEAT_LATE_S


def _require_one(ours: list[Instance], running: list[Instance]) -> Instance:
    if len(ours) == 1:
        return ours[0]
    if not running:
        raise CommandRefusedError("no Webots runs on this machine")
    worlds = ", ".join(f"{found.world or 'a world'} at port {found.port}" for found in running)
    if ours:
        raise CommandRefusedError(
            f"{len(ours)} Webots run ({worlds}), and no live session shows which one to steer: "
            "give its port"
        )
    raise CommandRefusedError(
        f"the Webots that runs here is not of this recording's project ({worlds}): give its port "
        "to steer it nevertheless"
    )
