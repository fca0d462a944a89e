"""The classes of a controller's robot: `Robot`, `Supervisor` and `Keyboard`."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable
from typing import Any, ClassVar, Final

from . import simulator_link as library
from .devices import CLASS_OF, Device
from .scene import Node, node_of
from .simulator_link import ControllerSession, NodeFacts, SimulatorLink, SocketLink
from .surface import Completed, integer, lacking, number, say, text

_NULL_NODE: Final = (0, "", "", "", -1)
_MOVIE_READY: Final = 0
_MOVIE_SAVING: Final = 2
_MAX_CUSTOM_DATA_BYTES: Final = 65_534
"""Webots' library sends the length in 16 bits, and takes the rest of a longer text for messages."""


def _deprecated(getter: str) -> Callable[[Robot, str], Any]:
    """Return a deprecated getter of a device, such as `getGPS`."""

    def get(self: Robot, name: str) -> Any:
        use = "please use Robot.getDevice instead."
        say(f"DEPRECATION: Robot.{getter} is deprecated, {use}")
        return self.getDevice(name)

    return get


class Keyboard(Completed):
    """A keyboard on which no key is ever pressed."""

    def __init__(self, sampling_period: int | None = None) -> None:
        self._period_ms = 0
        self.enable(sampling_period or 0)

    def enable(self, p: int) -> None:
        """Read the keyboard once in `p` milliseconds; 0 disables."""
        self._period_ms = integer(p)

    def disable(self) -> None:
        """Stop reading the keyboard."""
        self.enable(0)

    def getSamplingPeriod(self) -> int:
        """Return the sampling period in milliseconds, 0 if disabled."""
        return self._period_ms

    def getKey(self) -> int:
        """Return -1: no key is pressed."""
        if not self._period_ms:
            say(
                "Error: wb_keyboard_get_key() called for a disabled device! "
                "Please use: wb_keyboard_enable()."
            )
        return -1

    def getKeyCode(self) -> int:
        """Return -1: no key is pressed."""
        return self.getKey()


class Robot(Completed):
    """The robot that this process controls. A process has only one."""

    created: ClassVar[Robot | None] = None
    """The first robot that was constructed."""

    _session: ControllerSession
    devices: dict[str, Device]
    """All devices by name."""
    keyboard: Keyboard

    def __init__(self) -> None:
        link = self._connect()
        if link is None:
            return
        Robot.created = self
        self._session = library.current = ControllerSession(link)
        described = self._session.robot["devices"]
        self._by_tag = {d["tag"]: CLASS_OF[d["node_type"]](d["tag"]) for d in described}
        self.keyboard = Keyboard()
        self.devices = {device.name: device for device in self._by_tag.values()}

    def _connect(self) -> SimulatorLink | None:
        if Robot.created is not None:
            say("Error: Only one instance of the Robot class should be created.")
            self._session = Robot.created._session
            return None
        _restore_signals()
        return SocketLink()

    def __del__(self) -> None:
        if "devices" in self.__dict__:
            self._session.link.close()

    # Time ----------------------------------------------------------------------------------------

    def step(self, time_step: int | None = None) -> int:
        """Let time pass.

        Args:
            time_step: Milliseconds of simulated time, rounded up to a multiple of the basic time
                step; None for one basic time step. 0 only exchanges values, even while paused.

        Returns:
            0, or -1 once the simulation ends this controller. For a robot without synchronization
            that was late, the delay in milliseconds.
        """
        return self._session.step(self._duration_ms(time_step))

    def stepBegin(self, time_step: int | None = None) -> int:
        """Do the first half of `step`: request that time passes. Returns at once; -1 at the end."""
        return self._session.begin_step(self._duration_ms(time_step))

    def stepEnd(self) -> int:
        """Do the second half of `step`: wait until time has passed."""
        return self._session.end_step()

    def _duration_ms(self, time_step: int | None) -> int:
        return int(self.getBasicTimeStep()) if time_step is None else integer(time_step)

    def getTime(self) -> float:
        """Return simulated time in seconds, as of the last step."""
        return self._session.time_s

    def getBasicTimeStep(self) -> float:
        """Return the world's `basicTimeStep` in milliseconds, a float: use `step(int(...))`."""
        return float(self._session.robot["basic_time_step"])

    # Devices -------------------------------------------------------------------------------------

    def getDevice(self, name: str) -> Any:
        """Return the device with this name; print an error and return None if there is none.

        Raises:
            NotInStandInError: The robot has such a device in the world, but the stand-in lacks it.
        """
        device = self.devices.get(name)
        left_out: dict[str, str] = self._session.robot["left_out"]
        if device is None and name in left_out:
            raise lacking(f"{left_out[name]} nodes, so robot {self.getName()!r} has no {name!r}")
        if device is None:
            say(f'Device "{name}" was not found on robot "{self.getName()}"')
        return device

    def getKeyboard(self) -> Keyboard:
        """Return the keyboard, on which no key is ever pressed."""
        return self.keyboard

    def getNumberOfDevices(self) -> int:
        """Return the number of devices of the robot."""
        return len(self._by_tag)

    def getDeviceByIndex(self, index: int) -> Any:
        """Return a device by its index in the order of the scene tree.

        Raises:
            KeyError: There is none; an error is printed as well.
        """
        tags = [*self._by_tag]
        if not 0 <= integer(index) < len(tags):
            say("Error: The index of wb_robot_get_device_by_index() is out of the bounds.")
            raise KeyError(self.getName())
        return self._by_tag[tags[index]]

    # Fields of the robot's node and of the world --------------------------------------------------

    def getName(self) -> str:
        """Return the `name` field."""
        return self._session.robot["name"]

    def getModel(self) -> str:
        """Return the `model` field."""
        return self._session.robot["model"]

    def getCustomData(self) -> str:
        """Return the `customData` field."""
        return self._session.custom_data

    def setCustomData(self, data: str) -> None:
        """Set the `customData` field with the next step."""
        if len(text(data).encode()) > _MAX_CUSTOM_DATA_BYTES:
            raise lacking(f"customData of over {_MAX_CUSTOM_DATA_BYTES:,} bytes: what Webots does")
        self._session.set_custom_data(text(data))

    def getSupervisor(self) -> bool:
        """Return whether the world gives this robot a supervisor's rights."""
        return self._session.robot["supervisor"]

    def getSynchronization(self) -> bool:
        """Return whether the world waits for this controller."""
        return self._session.robot["synchronization"]

    def getWorldPath(self) -> str:
        """Return the path of the world file."""
        return self._session.robot["world_path"]

    def getProjectPath(self) -> str:
        """Return the folder that contains `worlds` and `controllers`."""
        return self._session.robot["project_path"]

    def getMode(self) -> int:
        """Return 0, simulation. The mode is about remote control, not about pause."""
        return 0


def _restore_signals() -> None:
    """Let signals end the process at once, without KeyboardInterrupt, `finally` or atexit."""
    numbers = [
        getattr(signal, name)
        for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")
        if hasattr(signal, name)
    ]
    if (
        os.name == "posix"
    ):  # As in Webots, set the handler of C, which `signal.getsignal` cannot see.
        c_signal = ctypes.CDLL(None).signal
        c_signal.argtypes, c_signal.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
        for number in numbers:
            c_signal(number, None)  # SIG_DFL
    elif threading.current_thread() is threading.main_thread():  # Python allows it only there.
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


for _device in {*CLASS_OF.values()}:
    setattr(Robot, f"get{_device.__name__}", _deprecated(f"get{_device.__name__}"))


class Supervisor(Robot):
    """A robot with more methods. The world decides whether it may use them."""

    SIMULATION_MODE_PAUSE = 0
    SIMULATION_MODE_REAL_TIME = 1
    SIMULATION_MODE_FAST = 2

    # Nodes ---------------------------------------------------------------------------------------

    def getRoot(self) -> Node:
        """Return the root node, whose `children` are the top of the scene tree."""
        return self._known("root")

    def getSelf(self) -> Node:
        """Return the robot's own node."""
        return self._known("self")

    def _known(self, which: str) -> Node:
        """Return a node that the simulator described when the controller connected."""
        is_allowed = self._session.is_supervisor(f"wb_supervisor_node_get_{which}()")
        return node_of(self._session, self._session.robot[which] if is_allowed else _NULL_NODE)

    def getFromDef(self, d: str) -> Node | None:
        """Return the node with this DEF name (`A.B`: B inside A); None if there is none."""
        name = text(d).rpartition(".")[2]
        return self._node("node_get_from_def", d, lambda node: node[3] == name)

    def getFromId(self, id: int) -> Node | None:  # noqa: A002 - Webots' name
        """Return the node with this number; None if there is none."""
        return self._node("node_get_from_id", integer(id), lambda node: node[0] == id)

    def getFromDevice(self, tag: int) -> Node | None:
        """Return the node of a device, by the device's tag; None if there is none."""
        return self._node("node_get_from_device", integer(tag), lambda _: False)

    def _node(
        self, operation: str, argument: Any, matches: Callable[[NodeFacts], bool]
    ) -> Node | None:
        found = self._session.find_node(operation, argument, matches)
        return None if found is None else node_of(self._session, found)

    # The simulation ------------------------------------------------------------------------------

    def simulationGetMode(self) -> int:
        """Return the mode as of the last answer of the simulator."""
        return self._session.mode

    def simulationSetMode(self, mode: int) -> None:
        """Pause, run in real time or run fast. Any other number pauses."""
        self._session.ask("simulation_set_mode", integer(mode))
        if self._session.is_quitting:
            self._session.mode = mode

    def simulationReset(self) -> None:
        """Reset the world at the end of the next physics step. Controllers keep running."""
        self._session.ask("simulation_reset")

    def simulationQuit(self, status: int) -> None:
        """End the simulation with an exit status."""
        self._session.ask("simulation_quit", integer(status))

    def worldReload(self) -> None:
        """Reload the world from its file. The next step returns -1."""
        self._session.ask("world_reload")

    def worldLoad(self, filename: str) -> None:
        """Load another world after the next physics step."""
        self._session.ask("world_load", text(filename))

    def worldSave(self, filename: str | None = None) -> int:
        """Write the world as it is now; 0 if that fails. From then on a reset returns to now."""
        if filename is not None and not text(filename).endswith(".wbt"):
            say(
                "Error: the target file given to wb_supervisor_world_save() should have the "
                "'.wbt' extension."
            )
            return 0
        return self._session.ask("world_save", filename, default=1)

    # Pictures ------------------------------------------------------------------------------------

    def exportImage(self, filename: str, quality: int) -> None:
        """Let the simulator write a .png or .jpg picture with the next rendering."""
        filename, quality = text(filename), integer(quality)
        if not 1 <= quality <= 100:
            say(f"Error: wb_supervisor_export_image(): quality {quality} is not between 1 and 100.")
            return
        self._session.ask("export_image", filename, quality)

    def movieStartRecording(
        self,
        filename: str,
        width: int,
        height: int,
        codec: int,
        quality: int,
        acceleration: int,
        caption: bool,
    ) -> None:
        """Let the simulator film the arena from above from the next step on, at 25 pictures a s.

        Codec, acceleration and caption are checked, and change nothing.
        """
        name, numbers = text(filename), [integer(each) for each in (width, height, quality)]
        integer(codec)
        integer(acceleration)
        wrong = ""
        if not self.movieIsReady():
            wrong = "movie recording has already been started."
        elif not name:
            wrong = "called with NULL or empty 'filename' argument."
        elif numbers[0] <= 0 or numbers[1] <= 0:
            wrong = "'width' and 'height' arguments must be postitive."
        elif not 1 <= quality <= 100:
            wrong = f"'quality' argument ({quality}) must be between 1 and 100."
        elif acceleration < 1:
            wrong = "'acceleration' argument must be greater than or equal to 1."
        if wrong:
            say(f"Error: wb_supervisor_movie_start_recording(): {wrong}")
        else:
            self._session.ask("movie_start_recording", name, *numbers)

    def movieStopRecording(self) -> None:
        """End the film; its file is written a moment later."""
        self._session.ask("movie_stop_recording")

    def movieIsReady(self) -> bool:
        """Return whether no movie is being recorded or written."""
        status = self._movie_status()
        return status == _MOVIE_READY or status > _MOVIE_SAVING

    def movieFailed(self) -> bool:
        """Return whether the last movie could not be made."""
        return self._movie_status() > _MOVIE_SAVING

    def _movie_status(self) -> int:
        return self._session.ask("movie_status", kept_as="movie_status", default=_MOVIE_READY)

    def animationStartRecording(self, filename: str) -> int:
        """Let the simulator record the poses of what moves, for an .html file; 0 if it cannot."""
        name = text(filename)
        if not name.endswith(".html"):
            say(
                "Error: the target file given to wb_supervisor_animation_start_recording() should "
                "have the '.html' extension."
            )
            return 0
        return self._session.ask("animation_start_recording", name, default=1)

    def animationStopRecording(self) -> int:
        """End the animation, and let the simulator write its files; 0 if it cannot."""
        return self._session.ask("animation_stop_recording", default=1)

    def setLabel(
        self,
        id: int,  # noqa: A002 - Webots' name
        label: str,
        x: float,
        y: float,
        size: float,
        color: int,
        transparency: float = 0.0,
        font: str = "Arial",
    ) -> None:
        """Show a text over the picture. Ids are 0 to 99; x, y and size range from 0 to 1."""
        number(transparency)
        text(font)
        place = (number(x), number(y), number(size))
        self._session.ask("set_label", integer(id), text(label), *place, integer(color))
