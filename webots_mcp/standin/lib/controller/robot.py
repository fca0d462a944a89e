"""The robot: stepping, devices, and what the world says about it."""

# ruff: noqa: N802, N815 - the names are those of Webots

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Callable
from typing import Any, ClassVar, Final

from . import session as library
from .arguments import integer, text
from .camera import Camera
from .console import say
from .device import Device
from .keyboard import Keyboard
from .lacking import lacking, lacks
from .led import LED
from .lidar import Lidar
from .motor import Motor
from .sensors import (
    GPS,
    Accelerometer,
    Compass,
    DistanceSensor,
    Gyro,
    InertialUnit,
    LightSensor,
    PositionSensor,
    TouchSensor,
)
from .session import Link, Session
from .socket_link import SocketLink

_DEVICE_CLASSES: Final[dict[str, type[Device]]] = {
    device_class.__name__: device_class
    for device_class in (
        *(Motor, PositionSensor, DistanceSensor, GPS, InertialUnit, Lidar, Camera, LED),
        *(Accelerometer, Compass, Gyro, LightSensor, TouchSensor),
    )
}
_DEADLY_SIGNALS: Final = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")


def _deprecated(getter: str) -> Callable[[Robot, str], Any]:
    """The old way to a device, as `getGPS`."""

    def get(self: Robot, name: str) -> Any:
        use = "please use Robot.getDevice instead."
        say(f"DEPRECATION: Robot.{getter} is deprecated, {use}")
        return self.getDevice(name)

    return get


@lacks(
    "EVENT_JOYSTICK_AXIS EVENT_JOYSTICK_BUTTON EVENT_JOYSTICK_POV EVENT_KEYBOARD "
    "EVENT_MOUSE_CLICK EVENT_MOUSE_MOVE EVENT_NO_EVENT EVENT_QUIT "
    "batterySensorDisable batterySensorEnable batterySensorGetSamplingPeriod "
    "batterySensorGetValue battery_sensor_sampling_period getAltimeter getBrake getConnector "
    "getDisplay getEmitter getJoystick getMouse getPen getRadar getRangeFinder "
    "getReceiver getSkin getSpeaker getUrdf joystick mouse setMode "
    "waitForUserInputEvent wwiReceiveText wwiSendText"
)
class Robot:
    """The robot that this process controls; a process has one."""

    MODE_SIMULATION, MODE_CROSS_COMPILATION, MODE_REMOTE_CONTROL = range(3)

    created: ClassVar[Robot | None] = None
    """The first robot that was made."""

    _session: Session
    devices: dict[str, Device]
    """All devices by name."""

    def __init__(self) -> None:
        link = self._connect()
        if link is None:
            return
        Robot.created = self
        self._session = library.current = Session(link)
        described = self._session.robot["devices"]
        self._by_tag = {d["tag"]: _DEVICE_CLASSES[d["kind"]](d["tag"]) for d in described}
        self.keyboard = Keyboard()
        self.devices = {device.name: device for device in self._by_tag.values()}

    def _connect(self) -> Link | None:
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
                step. None: one basic time step. 0 only exchanges values, also while paused.

        Returns:
            0; -1 once the simulation ends this controller. More than 0 for a robot without
            synchronization that asked too late: by how many milliseconds.
        """
        return self._session.step(self._duration_ms(time_step))

    def stepBegin(self, time_step: int | None = None) -> int:
        """The first half of `step`: asks for time to pass and returns at once."""
        self._session.begin_step(self._duration_ms(time_step))
        return 0

    def stepEnd(self) -> int:
        """The second half of `step`: waits until time has passed."""
        return self._session.end_step()

    def _duration_ms(self, time_step: int | None) -> int:
        return int(self.getBasicTimeStep()) if time_step is None else integer(time_step)

    def getTime(self) -> float:
        """Simulated time in seconds, as of the last step."""
        return self._session.time_s

    @property
    def time(self) -> float:
        """Simulated time in seconds, as of the last step."""
        return self.getTime()

    def getBasicTimeStep(self) -> float:
        """The world's `basicTimeStep` in milliseconds: a float, so `step(int(...))`."""
        return float(self._session.robot["basic_time_step"])

    @property
    def basic_time_step(self) -> float:
        """The world's `basicTimeStep` in milliseconds."""
        return self.getBasicTimeStep()

    # Devices -------------------------------------------------------------------------------------

    def getDevice(self, name: str) -> Any:
        """The device with this name; None and a line on stderr if there is none.

        Raises:
            NotInStandInError: The world gives the robot such a device, the stand-in has none.
        """
        device = self.devices.get(name)
        left_out: dict[str, str] = self._session.robot["left_out"]
        if device is None and name in left_out:
            raise lacking(f"{left_out[name]} nodes, so robot {self.getName()!r} has no {name!r}")
        if device is None:
            say(f'Device "{name}" was not found on robot "{self.getName()}"')
        return device

    getAccelerometer = _deprecated("getAccelerometer")
    getCamera = _deprecated("getCamera")
    getCompass = _deprecated("getCompass")
    getDistanceSensor = _deprecated("getDistanceSensor")
    getGPS = _deprecated("getGPS")
    getGyro = _deprecated("getGyro")
    getInertialUnit = _deprecated("getInertialUnit")
    getLED = _deprecated("getLED")
    getLidar = _deprecated("getLidar")
    getLightSensor = _deprecated("getLightSensor")
    getMotor = _deprecated("getMotor")
    getPositionSensor = _deprecated("getPositionSensor")
    getTouchSensor = _deprecated("getTouchSensor")

    def getKeyboard(self) -> Keyboard:
        """The keyboard, on which no keys are pressed."""
        return self.keyboard

    def getNumberOfDevices(self) -> int:
        """How many devices the robot has."""
        return len(self._by_tag)

    @property
    def number_of_devices(self) -> int:
        """How many devices the robot has."""
        return self.getNumberOfDevices()

    def getDeviceByIndex(self, index: int) -> Any:
        """The device at a place in the scene tree's order.

        Raises:
            KeyError: There is none; a line on stderr says so as well.
        """
        tags = [*self._by_tag]
        if not 0 <= integer(index) < len(tags):
            say("Error: The index of wb_robot_get_device_by_index() is out of the bounds.")
            raise KeyError(self.getName())
        return self._by_tag[tags[index]]

    # What the world says -------------------------------------------------------------------------

    def getName(self) -> str:
        """The `name` field."""
        return self._session.robot["name"]

    @property
    def name(self) -> str:
        """The `name` field."""
        return self.getName()

    def getModel(self) -> str:
        """The `model` field."""
        return self._session.robot["model"]

    @property
    def model(self) -> str:
        """The `model` field."""
        return self.getModel()

    def getCustomData(self) -> str:
        """The `customData` field."""
        return self._session.custom_data

    def setCustomData(self, data: str) -> None:
        """Set the `customData` field with the next step."""
        self._session.set_custom_data(text(data))

    @property
    def custom_data(self) -> str:
        """The `customData` field."""
        return self.getCustomData()

    @custom_data.setter
    def custom_data(self, data: str) -> None:
        self.setCustomData(data)

    def getSupervisor(self) -> bool:
        """Whether the world gives this robot a supervisor's rights."""
        return self._session.robot["supervisor"]

    @property
    def supervisor(self) -> bool:
        """Whether the world gives this robot a supervisor's rights."""
        return self.getSupervisor()

    def getSynchronization(self) -> bool:
        """Whether the world waits for this controller."""
        return self._session.robot["synchronization"]

    @property
    def synchronization(self) -> bool:
        """Whether the world waits for this controller."""
        return self.getSynchronization()

    def getWorldPath(self) -> str:
        """The world file."""
        return self._session.robot["world_path"]

    @property
    def world_path(self) -> str:
        """The world file."""
        return self.getWorldPath()

    def getProjectPath(self) -> str:
        """The folder that holds `worlds` and `controllers`."""
        return self._session.robot["project_path"]

    @property
    def project_path(self) -> str:
        """The folder that holds `worlds` and `controllers`."""
        return self.getProjectPath()

    def getMode(self) -> int:
        """0: simulation. This is about remote control, not about pause."""
        return 0

    @property
    def mode(self) -> int:
        """0: simulation. This is about remote control, not about pause."""
        return self.getMode()


def _restore_signals() -> None:
    """Signals end the process at once, without KeyboardInterrupt, `finally` or atexit."""
    numbers = [getattr(signal, name) for name in _DEADLY_SIGNALS if hasattr(signal, name)]
    if os.name == "posix":  # as in Webots C's handler is set: `signal.getsignal` knows nothing
        c_signal = ctypes.CDLL(None).signal
        c_signal.argtypes, c_signal.restype = (ctypes.c_int, ctypes.c_void_p), ctypes.c_void_p
        for number in numbers:
            c_signal(number, None)  # SIG_DFL
    elif threading.current_thread() is threading.main_thread():  # Python lets no other do this
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
