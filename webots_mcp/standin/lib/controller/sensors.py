"""Sensors that give numbers."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

import ctypes
from math import cos, hypot, nan, sin
from typing import Any, Final

from .console import say
from .device import Device, Sensor
from .lacking import lacks

_MEMORY: Final = [0.4375, -0.0625, 1.2890625, 0.734375]
"""What stands in the memory that Webots reads before an InertialUnit's first value: any numbers."""
_UNKNOWN: Final = [nan, nan, nan]
_NO_GPS: Final = [_UNKNOWN, _UNKNOWN]


class _Looked(Sensor):
    """A sensor with a lookup table."""

    def getLookupTable(self) -> list[float]:
        """What is measured, the value that comes of it, and the noise, one after the other."""
        return [*self._description["lookup_table"]]

    @property
    def lookup_table(self) -> list[float]:
        """What is measured, the value that comes of it, and the noise, one after the other."""
        return self.getLookupTable()


class _Vector(_Looked):
    """A sensor that gives three numbers along its own axes."""

    def getValues(self) -> list[float]:
        """Along x, y and z of the sensor; NaN before the first value."""
        return [*self._value(_UNKNOWN, "get_values")]

    @property
    def value(self) -> list[float]:
        """Along x, y and z of the sensor; NaN before the first value."""
        return self.getValues()


class Accelerometer(_Vector):
    """Acceleration in metres a second squared; standing still it shows g, upwards."""

    _c_name = "accelerometer"


class Gyro(_Vector):
    """Turning speed in radians a second."""

    _c_name = "gyro"


class Compass(_Vector):
    """The direction of north, which is the world's y axis."""

    _c_name = "compass"


class LightSensor(_Looked):
    """How much light falls on it, translated by the lookup table."""

    _c_name = "light_sensor"

    def getValue(self) -> float:
        """The measured value; NaN before the first one."""
        return self._value(nan)

    @property
    def value(self) -> float:
        """The measured value; NaN before the first one."""
        return self.getValue()


class TouchSensor(_Looked):
    """Whether, or how hard, the robot runs into something where the sensor is."""

    _c_name = "touch_sensor"
    BUMPER, FORCE, FORCE3D = range(3)

    def getValue(self) -> float:
        """Of a bumper 1 or 0, of a force sensor newtons, translated by the lookup table."""
        if self.getType() == self.FORCE3D:
            self._complain(
                "get_value",
                " can only be used with the 'bumper' or 'force' types of TouchSensor. "
                "Please use wb_touch_sensor_get_values().",
            )
            return nan
        return self._value(nan)

    @property
    def value(self) -> float:
        """Of a bumper 1 or 0, of a force sensor newtons, translated by the lookup table."""
        return self.getValue()

    def getValues(self) -> Any:
        """Newtons along x, y and z of a force-3d sensor: a `ctypes` pointer, so take `[:3]`."""
        values = _UNKNOWN
        if self.getType() == self.FORCE3D:
            values = self._value(_UNKNOWN, "get_values")
        else:
            self._complain("get_values", " can only be used with a device of type 'force-3d'.")
        return ctypes.cast((ctypes.c_double * 3)(*values), ctypes.POINTER(ctypes.c_double))

    @property
    def values(self) -> Any:
        """Newtons along x, y and z of a force-3d sensor: a `ctypes` pointer, so take `[:3]`."""
        return self.getValues()

    def getType(self) -> int:
        """`TouchSensor.BUMPER`, `FORCE` or `FORCE3D`."""
        return self._description["type"]

    @property
    def type(self) -> int:
        """`TouchSensor.BUMPER`, `FORCE` or `FORCE3D`."""
        return self.getType()


class PositionSensor(Sensor):
    """How far a joint has turned."""

    _c_name = "position_sensor"
    ROTATIONAL, LINEAR = range(2)

    def getValue(self) -> float:
        """Angle in radians; NaN before the first value."""
        return self._value(nan)

    @property
    def value(self) -> float:
        """Angle in radians; NaN before the first value."""
        return self.getValue()

    def getType(self) -> int:
        """`PositionSensor.ROTATIONAL`."""
        return self.ROTATIONAL

    @property
    def type(self) -> int:
        """`PositionSensor.ROTATIONAL`."""
        return self.getType()

    def getMotor(self) -> Device | None:
        """None and a line on stderr: broken in Webots' Python package."""
        say("Error: wb_brake_get_motor(): invalid device tag.")
        return None

    @property
    def motor(self) -> Device | None:
        """None and a line on stderr: broken in Webots' Python package."""
        return self.getMotor()

    def getBrake(self) -> None:
        """None: the stand-in has no brakes."""

    @property
    def brake(self) -> None:
        """None: the stand-in has no brakes."""


class DistanceSensor(_Looked):
    """The distance to the next obstacle, translated by the lookup table."""

    _c_name = "distance_sensor"
    GENERIC, INFRA_RED, SONAR, LASER = range(4)

    def getValue(self) -> float:
        """The measured value; NaN before the first one."""
        return self._value(nan)

    @property
    def value(self) -> float:
        """The measured value; NaN before the first one."""
        return self.getValue()

    def getMaxValue(self) -> float:
        """The largest value of the lookup table."""
        return self._description["max_value"]

    @property
    def max_value(self) -> float:
        """The largest value of the lookup table."""
        return self.getMaxValue()

    def getMinValue(self) -> float:
        """The smallest value of the lookup table."""
        return self._description["min_value"]

    @property
    def min_value(self) -> float:
        """The smallest value of the lookup table."""
        return self.getMinValue()

    def getAperture(self) -> float:
        """The `aperture` field, in radians; the stand-in looks along one ray."""
        return self._description["aperture"]

    @property
    def aperture(self) -> float:
        """The `aperture` field, in radians; the stand-in looks along one ray."""
        return self.getAperture()

    def getType(self) -> int:
        """The `type` field, as `DistanceSensor.SONAR`."""
        return self._description["type"]

    @property
    def type(self) -> int:
        """The `type` field, as `DistanceSensor.SONAR`."""
        return self.getType()


@lacks("convertToDegreesMinutesSeconds")
class GPS(Sensor):
    """Where the sensor is."""

    _c_name = "gps"
    LOCAL, WGS84 = range(2)

    def getValues(self) -> list[float]:
        """x, y and z in metres; NaN before the first value."""
        return [*self._value(_NO_GPS, "get_values")[0]]

    @property
    def value(self) -> list[float]:
        """x, y and z in metres; NaN before the first value."""
        return self.getValues()

    def getSpeedVector(self) -> list[float]:
        """Velocity in metres a second since the last sample; NaN before the first value."""
        return [*self._value(_NO_GPS, "get_speed_vector")[1]]

    @property
    def speed_vector(self) -> list[float]:
        """Velocity in metres a second since the last sample; NaN before the first value."""
        return self.getSpeedVector()

    def getSpeed(self) -> float:
        """Speed in metres a second since the last sample; NaN before the first value."""
        return hypot(*self._value(_NO_GPS, "get_speed")[1])

    @property
    def speed(self) -> float:
        """Speed in metres a second since the last sample; NaN before the first value."""
        return self.getSpeed()

    def getCoordinateSystem(self) -> int:
        """`GPS.LOCAL`."""
        return self.LOCAL

    @property
    def coordinate_system(self) -> int:
        """`GPS.LOCAL`."""
        return self.getCoordinateSystem()


class InertialUnit(Sensor):
    """Which way the sensor is turned."""

    _c_name = "inertial_unit"

    def getRollPitchYaw(self) -> list[float]:
        """Roll, pitch and yaw in radians; before the first value plausible, wrong numbers."""
        return [*self._value(_MEMORY[:3], "get_roll_pitch_yaw")]

    @property
    def roll_pitch_yaw(self) -> list[float]:
        """Roll, pitch and yaw in radians; before the first value plausible, wrong numbers."""
        return self.getRollPitchYaw()

    def getQuaternion(self) -> list[float]:
        """x, y, z and w; before the first value plausible, wrong numbers."""
        angles = self._value(None, "get_quaternion")
        return [*_MEMORY] if angles is None else _quaternion(*angles)

    @property
    def quaternion(self) -> list[float]:
        """x, y, z and w; before the first value plausible, wrong numbers."""
        return self.getQuaternion()

    def getNoise(self) -> float:
        """The `noise` field; the stand-in measures exactly all the same."""
        return self._description["noise"]

    @property
    def noise(self) -> float:
        """The `noise` field; the stand-in measures exactly all the same."""
        return self.getNoise()


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    (cr, sr), (cp, sp), (cy, sy) = ((cos(a / 2.0), sin(a / 2.0)) for a in (roll, pitch, yaw))
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
