"""What auto_publish reads of devices that give more than one number.

The classes answer as those of Webots' package do (R2023b and R2025a).
"""

from __future__ import annotations

import ctypes
import math
from types import SimpleNamespace
from typing import Any

import pytest

from webots_mcp.bridge.devices import read_devices

Doubles = ctypes.POINTER(ctypes.c_double)
Floats = ctypes.POINTER(ctypes.c_float)


class Sensor:
    def getSamplingPeriod(self) -> int:
        return 32


class TouchSensor(Sensor):
    BUMPER, FORCE, FORCE3D = 0, 1, 2

    def __init__(self, kind: int, values: Any) -> None:
        self.kind = kind
        self.values = values

    def getType(self) -> int:
        return self.kind

    def getValue(self) -> float:
        return 1.0

    def getValues(self) -> Any:
        return self.values


class Ranger(Sensor):
    def __init__(self, ranges: list[float], columns: int) -> None:
        self.ranges = ranges
        self.columns = columns
        self.range_image: Any = (ctypes.c_float * len(ranges))(*ranges)

    def getRangeImage(self) -> list[float]:
        return self.ranges


class Lidar(Ranger):
    def getHorizontalResolution(self) -> int:
        return self.columns


class RangeFinder(Ranger):
    def getWidth(self) -> int:
        return self.columns


def read(device: Any) -> Any:
    return read_devices(SimpleNamespace(devices={"it": device}), raising)["sensors"]["it"]  # type: ignore[index]


def raising(_name: str, error: Exception) -> None:
    raise error


def test_a_force_3d_sensor_gives_a_bare_pointer_to_three_numbers() -> None:
    memory = (ctypes.c_double * 3)(0.5, -1.5, 9.75)
    force = ctypes.cast(memory, Doubles)
    assert read(TouchSensor(TouchSensor.FORCE3D, force)) == [0.5, -1.5, 9.75]
    assert read(TouchSensor(TouchSensor.FORCE3D, [0.5, -1.5, 9.75])) == [0.5, -1.5, 9.75]


def test_a_force_3d_sensor_without_a_value_is_not_read() -> None:
    assert read(TouchSensor(TouchSensor.FORCE3D, Doubles())) is None


def test_a_bumper_gives_a_number() -> None:
    assert read(TouchSensor(TouchSensor.BUMPER, Doubles())) == 1.0


@pytest.mark.parametrize("kind", [Lidar, RangeFinder])
def test_a_sector_is_a_direction_over_all_layers_or_rows(kind: type[Ranger]) -> None:
    upper = [5.0] * 16
    lower = [5.0] * 14 + [0.25, 5.0]
    assert read(kind([*upper, *lower], 16)) == {
        "count": 32,
        "min_m": 0.25,
        "min_index": 30,
        "sector_min_m": [5.0] * 7 + [0.25],
    }


def test_ten_directions_make_eight_sectors_that_leave_none_out() -> None:
    ranges = [float(i) for i in range(10, 20)]
    sectors = read(Lidar(ranges, 10))["sector_min_m"]
    assert sectors == [10.0, 11.0, 12.0, 13.0, 15.0, 16.0, 17.0, 18.0]


def test_a_lidar_of_three_beams_has_three_sectors() -> None:
    assert read(Lidar([3.0, math.inf, 2.0], 3))["sector_min_m"] == [3.0, math.inf, 2.0]


def test_what_is_no_number_hides_no_nearer_one() -> None:
    ranges = [5.0] * 2 + [math.nan, 0.25] + [5.0] * 12
    assert read(Lidar(ranges, 16))["min_m"] == 0.25


def test_a_lidar_that_sees_nothing_says_so() -> None:
    summary = read(Lidar([math.inf] * 8, 8))
    assert (summary["min_m"], summary["min_index"]) == (math.inf, None)


def test_a_lidar_without_data_is_not_read() -> None:
    lidar = Lidar([1.0], 1)
    lidar.range_image = Floats()
    assert read(lidar) is None
