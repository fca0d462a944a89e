"""A stand-in for Webots' Python package `controller`; its simulator is webots_mcp.standin."""

from __future__ import annotations

from .camera import Camera
from .device import Device, Sensor
from .field import Field
from .lidar import Lidar, LidarPoint
from .motor import Motor
from .node import Node
from .robot import Robot
from .sensors import GPS, DistanceSensor, InertialUnit, PositionSensor
from .supervisor import Supervisor

__all__ = [
    "GPS",
    "Camera",
    "Device",
    "DistanceSensor",
    "Field",
    "InertialUnit",
    "Lidar",
    "LidarPoint",
    "Motor",
    "Node",
    "PositionSensor",
    "Robot",
    "Sensor",
    "Supervisor",
]
