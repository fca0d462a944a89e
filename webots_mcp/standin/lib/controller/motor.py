"""Motors: setting and reading their commands."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

from math import isinf, isnan

from .arguments import number
from .device import Device
from .lacking import lacks
from .sensors import PositionSensor


@lacks(
    "available_force disableForceFeedback disableTorqueFeedback enableForceFeedback "
    "enableTorqueFeedback force force_feedback force_feedback_sampling_period "
    "getAvailableForce getForceFeedback getMaxForce getTorqueFeedback max_force setAvailableForce "
    "available_torque setAvailableTorque getAvailableTorque setControlPID setForce setTorque "
    "torque torque_feedback torque_feedback_sampling_period"
)
class Motor(Device):
    """Turns a joint. The getters give what was commanded, not what is measured."""

    _c_name = "motor"
    ROTATIONAL, LINEAR = range(2)

    def __init__(self, name: int | str) -> None:
        super().__init__(name)
        self._position = 0.0
        self._velocity: float = self._description.get("max_velocity", 0.0)
        self._acceleration: float = self._description.get("acceleration", -1.0)

    def setPosition(self, position: float) -> None:
        """Turn to an angle in radians; inf lets the motor run with `setVelocity`."""
        if isnan(position := number(position)):
            self._complain("set_position", " called with an invalid 'position' argument (NaN).")
            return
        self._position = position
        self._session.change(self._tag, "position", position)

    def setVelocity(self, velocity: float) -> None:
        """Set the speed in radians a second; the motor keeps within its `maxVelocity`."""
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
        """Limit how fast the speed changes, in radians a second squared; -1: no limit."""
        if isnan(acceleration := number(acceleration)):
            self._complain("set_acceleration", " called with an invalid argument (NaN).")
            return
        self._acceleration = acceleration
        self._session.change(self._tag, "acceleration", acceleration)

    def getForceFeedbackSamplingPeriod(self) -> int:
        """0: the stand-in measures no force, so that is never enabled."""
        return 0

    def getTorqueFeedbackSamplingPeriod(self) -> int:
        """0: the stand-in measures no torque, so that is never enabled."""
        return 0

    def getTargetPosition(self) -> float:
        """The commanded position in radians."""
        return self._position

    @property
    def target_position(self) -> float:
        """The commanded position in radians."""
        return self.getTargetPosition()

    @target_position.setter
    def target_position(self, position: float) -> None:
        self.setPosition(position)

    def getVelocity(self) -> float:
        """The commanded speed in radians a second."""
        return self._velocity

    @property
    def target_velocity(self) -> float:
        """The commanded speed in radians a second."""
        return self.getVelocity()

    @target_velocity.setter
    def target_velocity(self, velocity: float) -> None:
        self.setVelocity(velocity)

    def getAcceleration(self) -> float:
        """The commanded limit of acceleration; -1: none."""
        return self._acceleration

    @property
    def target_acceleration(self) -> float:
        """The commanded limit of acceleration; -1: none."""
        return self.getAcceleration()

    @target_acceleration.setter
    def target_acceleration(self, acceleration: float) -> None:
        self.setAcceleration(acceleration)

    def getMaxVelocity(self) -> float:
        """The `maxVelocity` field, radians a second."""
        return self._description["max_velocity"]

    @property
    def max_velocity(self) -> float:
        """The `maxVelocity` field, radians a second."""
        return self.getMaxVelocity()

    def getMinPosition(self) -> float:
        """The `minPosition` field; 0 like `getMaxPosition()` means no limits."""
        return self._description["min_position"]

    @property
    def min_position(self) -> float:
        """The `minPosition` field; 0 like `max_position` means no limits."""
        return self.getMinPosition()

    def getMaxPosition(self) -> float:
        """The `maxPosition` field; 0 like `getMinPosition()` means no limits."""
        return self._description["max_position"]

    @property
    def max_position(self) -> float:
        """The `maxPosition` field; 0 like `min_position` means no limits."""
        return self.getMaxPosition()

    def getMaxTorque(self) -> float:
        """The `maxTorque` field, newton metres."""
        return self._description["max_torque"]

    @property
    def max_torque(self) -> float:
        """The `maxTorque` field, newton metres."""
        return self.getMaxTorque()

    def getMultiplier(self) -> float:
        """The `multiplier` field; the stand-in couples no motors."""
        return self._description["multiplier"]

    @property
    def multiplier(self) -> float:
        """The `multiplier` field; the stand-in couples no motors."""
        return self.getMultiplier()

    def getType(self) -> int:
        """`Motor.ROTATIONAL` or `Motor.LINEAR`."""
        return self.LINEAR if self._description["is_linear"] else self.ROTATIONAL

    @property
    def type(self) -> int:
        """`Motor.ROTATIONAL` or `Motor.LINEAR`."""
        return self.getType()

    def getBrake(self) -> None:
        """None: the stand-in has no brakes."""

    @property
    def brake(self) -> None:
        """None: the stand-in has no brakes."""

    def getPositionSensor(self) -> PositionSensor | None:
        """The sensor of the same joint; None if there is none."""
        name = self._description["position_sensor"]
        for description in self._session.robot["devices"]:
            if name is not None and description["name"] == name:
                return PositionSensor(description["tag"])
        return None

    @property
    def position_sensor(self) -> PositionSensor | None:
        """The sensor of the same joint; None if there is none."""
        return self.getPositionSensor()
