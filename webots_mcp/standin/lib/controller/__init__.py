"""A stand-in for Webots' Python package `controller`; its simulator is webots_mcp.standin."""

# pyright: reportUnsupportedDunderAll=false

from __future__ import annotations

from .devices import (
    GPS,
    LED,
    Accelerometer,
    Camera,
    Compass,
    DistanceSensor,
    Emitter,
    Gyro,
    InertialUnit,
    Lidar,
    LightSensor,
    Motor,
    PositionSensor,
    Receiver,
    TouchSensor,
)
from .robot import Keyboard, Robot, Supervisor
from .scene import Field, Node
from .surface import MEMBERS, complete, lacking_class

__all__ = [  # noqa: PLE0604, RUF100 - as in Webots, where it makes `import *` fail
    GPS,
    LED,
    Accelerometer,
    Camera,
    Compass,
    DistanceSensor,
    Emitter,
    Field,
    Gyro,
    InertialUnit,
    Keyboard,
    Lidar,
    LightSensor,
    Motor,
    Node,
    PositionSensor,
    Receiver,
    Robot,
    Supervisor,
    TouchSensor,
]

for _name in MEMBERS:
    if _name in globals():
        complete(globals()[_name])
    else:
        globals()[_name] = lacking_class(_name)
