"""The points of a lidar's point cloud."""

from __future__ import annotations

import struct
from typing import Final

_FORMAT: Final = struct.Struct("fffif")


class LidarPoint:
    """A point of the point cloud: x, y and z in metres in the frame of the lidar."""

    def __init__(self, data: bytes, offset: int) -> None:
        self.x: float
        self.y: float
        self.z: float
        self.layer: int
        self.time: float
        self.x, self.y, self.z, self.layer, self.time = _FORMAT.unpack_from(
            data, offset * _FORMAT.size
        )


def pack_point(x_m: float, y_m: float, z_m: float, layer: int, time_s: float) -> bytes:
    """A point as the C library keeps it."""
    return _FORMAT.pack(x_m, y_m, z_m, layer, time_s)
