"""A stand-in for Webots' Python package `controller`; its simulator is webots_mcp.standin."""

# pyright: reportUnsupportedDunderAll=false

from __future__ import annotations

from typing import Any

from .camera import Camera
from .field import Field
from .keyboard import Keyboard
from .lacking import CLASSES
from .led import LED
from .lidar import Lidar
from .lidar_point import LidarPoint
from .motor import Motor
from .node import Node
from .robot import Robot
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
from .supervisor import Supervisor

__all__ = [  # noqa: PLE0604, RUF100 - as in Webots, where it makes `import *` fail
    GPS,
    LED,
    Accelerometer,
    Camera,
    Compass,
    DistanceSensor,
    Field,
    Gyro,
    InertialUnit,
    Keyboard,
    Lidar,
    LidarPoint,
    LightSensor,
    Motor,
    Node,
    PositionSensor,
    Robot,
    Supervisor,
    TouchSensor,
]


def __getattr__(name: str) -> Any:
    """A class that Webots has and the stand-in has not: to import, not to use."""
    if name in CLASSES:
        return CLASSES[name]
    raise AttributeError(f"module 'controller' has no attribute {name!r}")
