"""Sensors that give numbers."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from math import cos, hypot, nan, sin
from typing import Final

from .console import say
from .device import Device, Sensor

_MEMORY: Final = [0.4375, -0.0625, 1.2890625, 0.734375]
"""What stands in the memory that Webots reads before an InertialUnit's first value: any numbers."""


class PositionSensor(Sensor):
    """How far a joint has turned."""

    _c_name = "position_sensor"

    def getValue(self) -> float:
        """Angle in radians; NaN before the first value."""
        return self._value(nan)

    @property
    def value(self) -> float:
        """Angle in radians; NaN before the first value."""
        return self.getValue()

    def getType(self) -> int:
        """0: rotational."""
        return 0

    def getMotor(self) -> Device | None:
        """None and a line on stderr: broken in Webots' Python package."""
        say("Error: wb_position_sensor_get_brake(): no brake.")
        return None


class DistanceSensor(Sensor):
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

    def getMinValue(self) -> float:
        """The smallest value of the lookup table."""
        return self._description["min_value"]

    def getAperture(self) -> float:
        """The `aperture` field, in radians."""
        return self._description["aperture"]

    def getLookupTable(self) -> list[float]:
        """Distance, value and noise, one after the other."""
        return [*self._description["lookup_table"]]

    def getType(self) -> int:
        """`DistanceSensor.GENERIC`."""
        return self.GENERIC


class GPS(Sensor):
    """Where the sensor is."""

    _c_name = "gps"
    LOCAL, WGS84 = range(2)

    def getValues(self) -> list[float]:
        """x, y and z in metres; NaN before the first value."""
        return [*self._value([[nan] * 3, [nan] * 3], "get_values")[0]]

    @property
    def value(self) -> list[float]:
        """x, y and z in metres; NaN before the first value."""
        return self.getValues()

    def getSpeedVector(self) -> list[float]:
        """Velocity in metres a second since the last sample; NaN before the first value."""
        return [*self._value([[nan] * 3, [nan] * 3], "get_speed_vector")[1]]

    @property
    def speed_vector(self) -> list[float]:
        """Velocity in metres a second since the last sample; NaN before the first value."""
        return self.getSpeedVector()

    def getSpeed(self) -> float:
        """Speed in metres a second since the last sample; NaN before the first value."""
        return hypot(*self.getSpeedVector())

    @property
    def speed(self) -> float:
        """Speed in metres a second since the last sample; NaN before the first value."""
        return self.getSpeed()

    def getCoordinateSystem(self) -> int:
        """`GPS.LOCAL`."""
        return self.LOCAL


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
        """0: the stand-in measures exactly."""
        return 0.0


def _quaternion(roll: float, pitch: float, yaw: float) -> list[float]:
    (cr, sr), (cp, sp), (cy, sy) = ((cos(a / 2.0), sin(a / 2.0)) for a in (roll, pitch, yaw))
    return [
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    ]
