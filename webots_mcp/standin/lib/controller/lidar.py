"""The lidar."""

# ruff: noqa: N802 - the names are those of Webots

from __future__ import annotations

import ctypes
from math import cos, sin
from typing import Any

from .device import Sensor
from .lacking import lacking, lacks
from .lidar_point import LidarPoint, pack_point


@lacks("setFrequency")
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

    def getNumberOfPoints(self) -> int:
        """Points in the point cloud; 0 and a line on stderr unless it is enabled."""
        if self._has_points("get_number_of_points", "!"):
            return self.getHorizontalResolution() * self.getNumberOfLayers()
        return 0

    @property
    def number_of_points(self) -> int:
        """Points in the point cloud; 0 and a line on stderr unless it is enabled."""
        return self.getNumberOfPoints()

    def getPointCloud(self) -> list[LidarPoint]:
        """The scan as points, layer after layer; empty and lines on stderr unless enabled."""
        count = self.getNumberOfPoints()
        if not self._has_points("get_point_cloud", "."):
            return []
        data = self._packed_points()
        return [LidarPoint(data, offset) for offset in range(count)]

    def getLayerPointCloud(self, layer: int) -> list[LidarPoint]:
        """The points of one layer; empty and lines on stderr unless enabled."""
        size = self.getHorizontalResolution()
        return self.getPointCloud()[layer * size : (layer + 1) * size]

    def _has_points(self, what: str, mark: str) -> bool:
        if not self._with_points:
            use = "Please use: wb_lidar_enable_point_cloud()."
            self._complain(what, f" called for a lidar with point cloud disabled{mark} {use}")
        return self._with_points

    def _packed_points(self) -> bytes:
        resolution, fov = self.getHorizontalResolution(), self.getFov()
        step, time_s = fov / max(resolution - 1, 1), self._session.time_s
        points: list[bytes] = []
        for i, distance in enumerate(self.getRangeImage()):
            layer, column = divmod(i, resolution)
            angle = fov / 2.0 - column * step
            x, y = distance * cos(angle), distance * sin(angle)
            points.append(pack_point(x, y, 0.0, layer, time_s))
        return b"".join(points)

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

    @property
    def frequency(self) -> float:
        """The `defaultFrequency` field, hertz."""
        return self.getFrequency()

    @frequency.setter
    def frequency(self, frequency: float) -> None:
        raise lacking("Lidar.setFrequency")

    def getMinFrequency(self) -> float:
        """The `minFrequency` field, hertz."""
        return self._description["min_frequency"]

    @property
    def min_frequency(self) -> float:
        """The `minFrequency` field, hertz."""
        return self.getMinFrequency()

    def getMaxFrequency(self) -> float:
        """The `maxFrequency` field, hertz."""
        return self._description["max_frequency"]

    @property
    def max_frequency(self) -> float:
        """The `maxFrequency` field, hertz."""
        return self.getMaxFrequency()
