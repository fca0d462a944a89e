"""The lidar."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

import ctypes
from math import cos, sin
from typing import Any, NamedTuple

from .console import say
from .device import Sensor


class LidarPoint(NamedTuple):
    """A point of the point cloud: x, y and z in metres in the frame of the lidar."""

    x: float
    y: float
    z: float
    layer_id: int
    time: float


class Lidar(Sensor):
    """Measures a fan of distances from left to right, layer after layer."""

    _c_name = "lidar"
    _with_points = False

    def getRangeImage(self) -> list[float]:
        """Distances in metres, inf where nothing is in range.

        Raises:
            ValueError: There is no scan yet. In Webots this can also be a segmentation fault.
        """
        ranges = self._ranges()
        if ranges is None:
            raise ValueError("NULL pointer access")
        return [*ranges]

    def _ranges(self) -> list[float] | None:
        return self._value(None, "get_range_image") and self._session.fetch(self._tag)

    @property
    def range_image(self) -> Any:
        """The distances as a raw `ctypes` pointer, which is false while there is no scan."""
        ranges = self._ranges()
        if ranges is None:
            return ctypes.POINTER(ctypes.c_float)()
        array = (ctypes.c_float * len(ranges))(*ranges)
        return ctypes.cast(array, ctypes.POINTER(ctypes.c_float))

    def getLayerRangeImage(self, layer: int) -> list[float]:
        """Layer 0 whatever is asked for, as in Webots."""
        return self.getRangeImage()[: self.getHorizontalResolution()]

    def getRangeImageArray(self) -> list[list[float]]:
        """As many lists as there are layers, each of them layer 0, as in Webots."""
        return [self.getLayerRangeImage(i) for i in range(self.getNumberOfLayers())]

    def enablePointCloud(self) -> None:
        """Let `getPointCloud` work."""
        self._with_points = True

    def disablePointCloud(self) -> None:
        """Let `getPointCloud` work no longer."""
        self._with_points = False

    def isPointCloudEnabled(self) -> bool:
        """Whether `getPointCloud` works."""
        return self._with_points

    def getPointCloud(self) -> list[LidarPoint]:
        """The scan as points; empty and a line on stderr unless enabled."""
        if not self._with_points:
            say("Error: wb_lidar_get_point_cloud() called for a lidar with point cloud disabled!")
            return []
        resolution, fov = self.getHorizontalResolution(), self.getFov()
        step, ranges = fov / max(resolution - 1, 1), self.getRangeImage()[:resolution]
        angles = (fov / 2.0 - i * step for i in range(resolution))
        time_s = self._session.time_s
        return [
            LidarPoint(distance * cos(angle), distance * sin(angle), 0.0, 0, time_s)
            for distance, angle in zip(ranges, angles, strict=True)
        ]

    def getHorizontalResolution(self) -> int:
        """Distances in a layer."""
        return self._description["resolution"]

    @property
    def horizontal_resolution(self) -> int:
        """Distances in a layer."""
        return self.getHorizontalResolution()

    def getNumberOfLayers(self) -> int:
        """Layers; in the stand-in all of them are level."""
        return self._description["layers"]

    @property
    def number_of_layers(self) -> int:
        """Layers; in the stand-in all of them are level."""
        return self.getNumberOfLayers()

    def getFov(self) -> float:
        """Horizontal field of view in radians."""
        return self._description["fov"]

    @property
    def fov(self) -> float:
        """Horizontal field of view in radians."""
        return self.getFov()

    def getVerticalFov(self) -> float:
        """Vertical field of view in radians."""
        return self._description["vertical_fov"]

    @property
    def vertical_fov(self) -> float:
        """Vertical field of view in radians."""
        return self.getVerticalFov()

    def getMinRange(self) -> float:
        """The shortest distance it measures, metres."""
        return self._description["min_range"]

    @property
    def min_range(self) -> float:
        """The shortest distance it measures, metres."""
        return self.getMinRange()

    def getMaxRange(self) -> float:
        """The longest distance it measures, metres."""
        return self._description["max_range"]

    @property
    def max_range(self) -> float:
        """The longest distance it measures, metres."""
        return self.getMaxRange()

    def getFrequency(self) -> float:
        """The `defaultFrequency` field, hertz."""
        return self._description["frequency"]
