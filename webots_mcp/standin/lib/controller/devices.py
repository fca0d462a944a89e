"""The devices of a robot, as controllers use them.

Getters of constants return the fields of the device's node, which the simulator sends.
"""

# ruff: noqa: N802, N815 - the names are those of Webots

from __future__ import annotations

import ctypes
import struct
import sys
from collections import deque
from collections.abc import Callable
from math import cos, hypot, isinf, isnan, nan, sin, tan
from pathlib import Path
from typing import Any, Final, cast

from . import simulator_link as library
from .surface import Completed, integer, lacking, number, say, text, type_number

_MEMORY: Final = [0.4375, -0.0625, 1.2890625, 0.734375]
"""What Webots reads from memory before an InertialUnit's first value: any numbers."""
_UNKNOWN: Final = [nan, nan, nan]
_NO_GPS: Final = [_UNKNOWN, _UNKNOWN]


def _field(name: str, default: Any = None) -> Callable[[Any], Any]:
    """Return a getter for a field of the device's node."""

    def get(self: Any) -> Any:
        with self._session.lock:
            return self._fields.get(name, default)

    return get


class Device(Completed):
    """A device of the robot.

    `GPS("gps")` finds a device by its name. The robot itself makes its devices by tag.
    """

    _c_name = "device"
    """Name of the device in the C functions, for messages."""

    def __init__(self, name: int | str) -> None:
        session = library.current
        if session is None:
            raise RuntimeError("there are no devices before Robot() was made")
        self._session = session
        self._description = self._found(name)
        self._tag: int = self._description.get("tag", 0)
        self._fields: dict[str, Any] = self._description.get("fields", {})

    def _found(self, name: int | str) -> dict[str, Any]:
        for description in self._session.robot["devices"]:
            if name in (description["tag"], description["fields"]["name"]):
                return description
        say(f'Warning: "{name}" device not found.')
        return {}

    def _complain(self, what: str, complaint: str) -> None:
        say(f"Error: wb_{self._c_name}_{what}(){complaint}")

    getName = _field("name", "")
    getModel = _field("model", "")

    def getNodeType(self) -> int:
        """Return the number of the node type, to compare with `Node.GPS` and the like."""
        return type_number("Node", self._description.get("node_type", ""))


class Sensor(Device):
    """A device that measures periodically, once it is enabled."""

    def __init__(self, name: int | str, sampling_period: int | None = None) -> None:
        super().__init__(name)
        if isinstance(name, str):  # As in the real package, a device made by name is enabled.
            basic_ms = int(self._session.robot["basic_time_step"])
            self.enable(basic_ms if sampling_period is None else sampling_period)

    def enable(self, p: int) -> None:
        """Measure once in `p` milliseconds, from the next step on; 0 disables."""
        if integer(p, position=2) < 0:
            self._complain("enable", " called with negative sampling period.")
        elif not self._tag:
            self._complain("enable", ": invalid device tag.")
        else:
            self._session.enable(self._tag, p)

    def disable(self) -> None:
        """Stop measuring; the last value stays."""
        self.enable(0)

    def getSamplingPeriod(self) -> int:
        """Return the sampling period in milliseconds, 0 if disabled."""
        with self._session.lock:
            return self._session.periods_ms.get(self._tag, 0)

    def _value(self, default: Any, what: str = "get_value") -> Any:
        if not self.getSamplingPeriod():
            use = f"Please use: wb_{self._c_name}_enable()."
            self._complain(what, f" called for a disabled device! {use}")
        return self._session.value(self._tag, default)


class _NumberSensor(Sensor):
    """A sensor of one number."""

    def getValue(self) -> float:
        """Return the measured value; NaN before the first one."""
        return self._value(nan)


class _LookupTable(Sensor):
    """A sensor that converts its measurement by a lookup table."""

    def getLookupTable(self) -> list[float]:
        """Return measurement, value and noise of each row, one after the other."""
        return [value for row in self._fields["lookupTable"] for value in row]


class _VectorSensor(_LookupTable):
    """A sensor of a vector along its own axes."""

    def getValues(self) -> list[float]:
        """Return the vector along x, y and z of the sensor; NaN before the first value."""
        return [*self._value(_UNKNOWN, "get_values")]


class Accelerometer(_VectorSensor):
    """Measures acceleration in metres per second squared; at rest g, upwards."""

    _c_name = "accelerometer"


class Gyro(_VectorSensor):
    """Measures angular velocity in radians per second."""

    _c_name = "gyro"


class Compass(_VectorSensor):
    """Measures the direction of north, which is the world's y axis."""

    _c_name = "compass"


class LightSensor(_NumberSensor, _LookupTable):
    """Measures irradiance, converted by the lookup table."""

    _c_name = "light_sensor"


class DistanceSensor(_NumberSensor, _LookupTable):
    """Measures the distance to the next obstacle, converted by the lookup table."""

    _c_name = "distance_sensor"

    getAperture = _field("aperture")  # Radians. The stand-in measures along one ray.

    def getMaxValue(self) -> float:
        """Return the largest value of the lookup table."""
        return max((row[1] for row in self._fields["lookupTable"]), default=0.0)

    def getMinValue(self) -> float:
        """Return the smallest value of the lookup table."""
        return min((row[1] for row in self._fields["lookupTable"]), default=0.0)

    def getType(self) -> int:
        """Return the `type` field, such as `DistanceSensor.SONAR`."""
        return _index_of(self._fields["type"], ("generic", "infra-red", "sonar", "laser"))


class TouchSensor(_NumberSensor, _LookupTable):
    """Detects contact of the robot where the sensor is."""

    _c_name = "touch_sensor"
    BUMPER, FORCE, FORCE3D = range(3)

    def getValue(self) -> float:
        """Return 1 or 0; NaN before the first value."""
        if self.getType() != self.BUMPER:
            raise lacking(f"TouchSensor of type {self._fields['type']!r}")
        return super().getValue()

    def getType(self) -> int:
        """Return `TouchSensor.BUMPER`, `FORCE` or `FORCE3D`."""
        return _index_of(self._fields["type"], ("bumper", "force", "force-3d"))


class PositionSensor(_NumberSensor):
    """Measures how far a joint has turned, in radians, or slid, in metres."""

    _c_name = "position_sensor"
    ROTATIONAL = 0

    def getType(self) -> int:
        """Return `PositionSensor.ROTATIONAL`."""
        return self.ROTATIONAL


class GPS(Sensor):
    """Measures position and velocity in metres and metres per second.

    NaN before the first value.
    """

    _c_name = "gps"
    LOCAL = 0

    def getValues(self) -> list[float]:
        """Return x, y and z."""
        return [*self._value(_NO_GPS, "get_values")[0]]

    def getSpeedVector(self) -> list[float]:
        """Return the velocity since the last sample."""
        return [*self._value(_NO_GPS, "get_speed_vector")[1]]

    def getSpeed(self) -> float:
        """Return the speed since the last sample."""
        return hypot(*self._value(_NO_GPS, "get_speed")[1])

    def getCoordinateSystem(self) -> int:
        """Return `GPS.LOCAL`."""
        return self.LOCAL


class InertialUnit(Sensor):
    """Measures orientation. Before the first value it returns plausible but wrong numbers."""

    _c_name = "inertial_unit"

    getNoise = _field("noise")  # The stand-in measures without noise.

    def getRollPitchYaw(self) -> list[float]:
        """Return roll, pitch and yaw in radians."""
        return [*self._value(_MEMORY[:3], "get_roll_pitch_yaw")]

    def getQuaternion(self) -> list[float]:
        """Return x, y, z and w."""
        angles = self._value(None, "get_quaternion")
        return [*_MEMORY] if angles is None else _quaternion(*angles)


class LED(Device):
    """A lamp. It is not rendered, but stores its value."""

    _c_name = "led"

    def __init__(self, name: int | str) -> None:
        super().__init__(name)
        self._state = 0

    def set(self, v: int) -> None:
        """Switch the lamp on, with 1 or the index or RGB value of a color, or off with 0."""
        self._state = integer(v, position=2)

    def get(self) -> int:
        """Return the value that was set last."""
        return self._state


class Motor(Device):
    """Turns or slides a joint. The getters return what was commanded, not what is measured.

    Positions are in radians or metres, speeds and accelerations per second.
    """

    _c_name = "motor"
    ROTATIONAL, LINEAR = range(2)

    getMaxVelocity = _field("maxVelocity", 0.0)
    getMinPosition = _field("minPosition")  # Both 0: no limits.
    getMaxPosition = _field("maxPosition")
    getMaxTorque = _field("maxTorque", 0.0)
    getMultiplier = _field("multiplier")  # The stand-in couples no motors.

    def __init__(self, name: int | str) -> None:
        super().__init__(name)
        self._position = 0.0
        self._velocity: float = self.getMaxVelocity()
        self._acceleration: float = self._fields.get("acceleration", -1.0)

    def setPosition(self, position: float) -> None:
        """Set the target position; inf lets the motor run with the speed of `setVelocity`."""
        if isnan(position := number(position)):
            self._complain("set_position", " called with an invalid 'position' argument (NaN).")
            return
        self._position = position
        self._session.change(self._tag, "position", position)

    def setVelocity(self, velocity: float) -> None:
        """Set the speed, which `maxVelocity` limits."""
        if isnan(velocity := number(velocity)):
            self._complain("set_velocity", " called with an invalid 'velocity' argument.(NaN)")
        elif velocity < 0.0 and not isinf(self._position):
            self._complain(
                "set_velocity",
                " called with negative 'velocity' argument in position control mode "
                f"({self._position:g}).",
            )
        else:
            self._velocity = velocity
            self._session.change(self._tag, "velocity", velocity)

    def setAcceleration(self, acceleration: float) -> None:
        """Limit the acceleration; -1 for no limit."""
        if isnan(acceleration := number(acceleration)):
            self._complain("set_acceleration", " called with an invalid argument (NaN).")
            return
        self._acceleration = acceleration
        self._session.change(self._tag, "acceleration", acceleration)

    def getTargetPosition(self) -> float:
        """Return the commanded position."""
        return self._position

    def getVelocity(self) -> float:
        """Return the commanded speed."""
        return self._velocity

    def getAcceleration(self) -> float:
        """Return the commanded limit of acceleration; -1 for none."""
        return self._acceleration

    def getForceFeedbackSamplingPeriod(self) -> int:
        """Return 0: the stand-in measures no force."""
        return 0

    def getTorqueFeedbackSamplingPeriod(self) -> int:
        """Return 0: the stand-in measures no torque."""
        return 0

    def getType(self) -> int:
        """Return `Motor.ROTATIONAL` or `Motor.LINEAR`."""
        return int(self._description["node_type"] == "LinearMotor")

    def getPositionSensor(self) -> PositionSensor | None:
        """Return the position sensor of the same joint; None if there is none."""
        joint = self._description["joint"]
        tags = (
            other["tag"]
            for other in self._session.robot["devices"]
            if joint is not None
            and other["joint"] == joint
            and other["node_type"] == "PositionSensor"
        )
        tag = self._session.answer_locally(("position sensor", self._tag), next(tags, None))
        return None if tag is None else PositionSensor(tag)


class Camera(Sensor):
    """Takes pictures of four bytes a pixel, in the order blue, green, red, alpha."""

    _c_name = "camera"

    getWidth = _field("width")
    getHeight = _field("height")
    getNear = _field("near")
    getFov = _field("fieldOfView")

    def getImage(self) -> bytes:
        """Return the last picture, in rows from the top left.

        Raises:
            ValueError: The camera is disabled or has not taken a picture yet.
        """
        picture = self._value(None, "get_image") and self._session.fetch(self._tag)
        if picture is None or not self.getSamplingPeriod():
            raise ValueError("NULL pointer access")
        return picture

    def getImageArray(self) -> list[list[list[int]]]:
        """Return red, green and blue of each pixel, cut as by Webots: `width` lists of `height`."""
        image, width, height = self.getImage(), self.getWidth(), self.getHeight()
        pixels = [[image[i + 2], image[i + 1], image[i]] for i in range(0, len(image), 4)]
        return [pixels[x * height : (x + 1) * height] for x in range(width)]

    @staticmethod
    def imageGetRed(image: bytes, width: int, x: int, y: int) -> int:
        """Return red of one pixel, 0 to 255."""
        return image[4 * (y * width + x) + 2]

    @staticmethod
    def imageGetGreen(image: bytes, width: int, x: int, y: int) -> int:
        """Return green of one pixel, 0 to 255."""
        return image[4 * (y * width + x) + 1]

    @staticmethod
    def imageGetBlue(image: bytes, width: int, x: int, y: int) -> int:
        """Return blue of one pixel, 0 to 255."""
        return image[4 * (y * width + x)]

    @staticmethod
    def imageGetGray(image: bytes, width: int, x: int, y: int) -> float:
        """Return the mean of the three colors of one pixel."""
        start = 4 * (y * width + x)
        return sum(image[start : start + 3]) / 3.0

    def getFocalLength(self) -> float:
        """Return the focal length in pixels."""
        return self.getWidth() / 2.0 / tan(self.getFov() / 2.0)

    def hasRecognition(self) -> bool:
        """Return False: cameras of the stand-in recognize nothing."""
        return False

    def saveImage(self, filename: str, quality: int) -> int:
        """Write the last picture to a .png or .jpg file; return 0, or -1 if that fails."""
        path, quality = Path(text(filename)), integer(quality, position=3)
        if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            return -1
        from PIL import Image

        size, image = (self.getWidth(), self.getHeight()), self.getImage()
        try:
            Image.frombytes("RGBA", size, image, "raw", "BGRA").convert("RGB").save(
                path, quality=quality
            )
        except OSError:
            say(f"Insufficient permissions to write file: {filename}")
            return -1
        return 0


class Lidar(Sensor):
    """Measures a fan of distances from left to right in each layer. All layers are level."""

    _c_name = "lidar"

    getHorizontalResolution = _field("horizontalResolution")
    getNumberOfLayers = _field("numberOfLayers")
    getFov = _field("fieldOfView")
    getVerticalFov = _field("verticalFieldOfView")
    getMinRange = _field("minRange")
    getMaxRange = _field("maxRange")
    getFrequency = _field("defaultFrequency")
    getMinFrequency = _field("minFrequency")
    getMaxFrequency = _field("maxFrequency")

    def getRangeImage(self) -> list[float]:
        """Return distances in metres, inf where nothing is in range.

        Raises:
            ValueError: There is no scan yet. In Webots this may be a segmentation fault.
        """
        ranges = self._ranges()
        if ranges is None:
            raise ValueError("NULL pointer access")
        return [*ranges]

    def _ranges(self) -> list[float] | None:
        return self._value(None, "get_range_image") and self._session.fetch(self._tag)

    @property
    def range_image(self) -> Any:
        """Return the distances as a raw `ctypes` pointer, which is false before the first scan."""
        ranges = self._ranges()
        if ranges is None:
            return ctypes.POINTER(ctypes.c_float)()
        array = (ctypes.c_float * len(ranges))(*ranges)
        return ctypes.cast(array, ctypes.POINTER(ctypes.c_float))

    def getLayerRangeImage(self, layer: int) -> list[float]:
        """Return layer 0, whatever the argument, as Webots does."""
        return self.getRangeImage()[: self.getHorizontalResolution()]


class _Radio(Device):
    """A device that sends or receives packets on channels."""

    getChannel = _field("channel", -1)

    def setChannel(self, channel: int) -> None:
        """Use this channel; `Emitter.CHANNEL_BROADCAST` means all channels."""
        if not self._tag:
            self._complain("set_channel", ": invalid device tag.")
        elif integer(channel, position=2) < -1:
            self._complain(
                "set_channel",
                f" called with an invalid channel={channel}. "
                "Please use a channel inside the range [-1,inf).",
            )
        elif self._fields["allowedChannels"] and channel not in self._fields["allowedChannels"]:
            self._complain(
                "set_channel",
                f" called with channel={channel}, which is not between allowed channels. "
                "Please use an allowed channel.",
            )
        else:
            self._fields["channel"] = channel


class Emitter(_Radio):
    """Sends packets to receivers of other robots, which get them with the next basic time step."""

    _c_name = "emitter"

    getBufferSize = _field("bufferSize", -1)  # Bytes; -1 for no limit.
    getRange = _field("range", nan)  # Metres; -1 for everywhere.

    def send(self, message: Any, length: int | None = None) -> None:
        """Send a packet with the next step, with the present channel and range.

        Args:
            message: Text, bytes or a list of numbers, all of the type of the first number.
            length: Number of bytes to send; None for all.
        """
        if isinstance(message, bytes):
            packet = message if length is None else message[: max(length, 0)]
        elif isinstance(message, str):
            packet = message.encode()[: len(message)]  # As in Webots, which counts characters.
        elif isinstance(message, (list, tuple)):
            values = cast("list[Any]", message)
            if not values:
                self._refuse("empty list")
                return
            if not isinstance(values[0], (float, int)):
                self._refuse(f"unsupported data type list: {type(values)}")
                return
            kind = "d" if isinstance(values[0], float) else "i"
            packet = struct.pack(f"{len(values)}{kind}", *values)
        else:
            self._refuse(f"unsupported data type: {type(message)}")
            return
        if not packet:
            self._complain("send", f": invalid size={length or 0} argument.")
        elif not self._tag:
            self._complain("send", ": invalid device tag.")
        else:
            with self._session.lock:
                self._session.sent[self._tag].put(packet)

    def _refuse(self, why: str) -> None:
        print(f"Emitter.send(): {why}", file=sys.stderr)  # noqa: T201 - as Webots does

    def setRange(self, range: float) -> None:  # noqa: A002 - Webots' name
        """Set the range in metres, up to `maxRange`; -1 for `maxRange`."""
        wanted, most = number(range), self._fields.get("maxRange", -1.0)
        if not self._tag:
            self._complain("set_range", ": invalid device tag.")
        elif wanted < 0.0 and wanted != -1.0:
            self._complain("set_range", f": invalid range={wanted:f} argument.")
        elif wanted == -1.0 or wanted > most >= 0.0:
            self._fields["range"] = most
        else:
            self._fields["range"] = wanted


class Receiver(_Radio, Sensor):
    """Queues packets of other robots' emitters. Getters read the first until `nextPacket`."""

    _c_name = "receiver"

    def __init__(self, name: int | str, sampling_period: int | None = None) -> None:
        super().__init__(name, sampling_period)
        self._queue = self._session.received.get(self._tag, deque[Any]())

    def getQueueLength(self) -> int:
        """Return the number of packets in the queue."""
        if not self.getSamplingPeriod():
            use = "Please use: wb_receiver_enable()."
            self._complain("get_queue_length", f" called for a disabled device! {use}")
        return len(self._queue)

    def _head(self, what: str, part: int, default: Any = None) -> Any:
        """Return a part of the first packet: its bytes, the emitter's direction or the strength."""
        if self._queue:
            return self._queue[0][part]
        self._complain(what, ": the receiver queue is empty.")
        return default

    def nextPacket(self) -> None:
        """Remove the first packet from the queue."""
        if self._queue:
            self._queue.popleft()

    def getBytes(self) -> bytes:
        """Return the packet; without one print an error and return no bytes."""
        return self._head("get_data", 0, b"")

    def getString(self) -> str:
        """Return the packet as text.

        Raises:
            ValueError: There is no packet. In Webots this is a segmentation fault.
        """
        return _existing(self._head("get_data", 0)).decode()

    def getDataSize(self) -> int:
        """Return the number of bytes of the packet; -1 without one."""
        packet = self._head("get_data_size", 0)
        return -1 if packet is None else len(packet)

    def getFloats(self) -> tuple[float, ...]:
        """Return the packet as numbers of eight bytes."""
        return struct.unpack(f"{int(self.getDataSize() / 8)}d", self.getBytes())

    def getInts(self) -> tuple[int, ...]:
        """Return the packet as integers of four bytes."""
        return struct.unpack(f"{int(self.getDataSize() / 4)}i", self.getBytes())

    def getBools(self) -> tuple[bool, ...]:
        """Return the packet as flags of one byte."""
        return struct.unpack(f"{self.getDataSize()}?", self.getBytes())

    def getSignalStrength(self) -> float:
        """Return 1 divided by the square of the emitter's distance in metres."""
        return self._head("get_signal_strength", 2, nan)

    def getEmitterDirection(self) -> list[float]:
        """Return a unit vector to the position of the emitter, seen from the receiver.

        Raises:
            ValueError: There is no packet.
        """
        return [*_existing(self._head("get_emitter_direction", 1))]

    def setChannel(self, channel: int) -> None:
        """Listen to this channel; -1 for all channels."""
        super().setChannel(channel)
        self._session.change(self._tag, "channel", self._fields["channel"])


def _existing(value: Any) -> Any:
    if value is None:
        raise ValueError("NULL pointer access")
    return value


def _index_of(name: str, names: tuple[str, ...]) -> int:
    return names.index(name) if name in names else 0


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    (cr, sr), (cp, sp), (cy, sy) = ((cos(a / 2.0), sin(a / 2.0)) for a in (roll, pitch, yaw))
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]


CLASS_OF: Final[dict[str, type[Device]]] = {
    **{"RotationalMotor": Motor, "LinearMotor": Motor},
    **{
        each.__name__: each
        for each in (
            *(PositionSensor, DistanceSensor, GPS, InertialUnit, Lidar, Camera, LED, TouchSensor),
            *(Accelerometer, Compass, Gyro, LightSensor, Emitter, Receiver),
        )
    },
}
"""Classes of devices by node type."""
