"""A picture of a device's current measurement, independent of the controller's code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

from webots_mcp.bridge.picture_files import image_of
from webots_mcp.errors import CommandRefusedError, InvalidInputError

_MOST_NAMED: Final = 10


class Picture(NamedTuple):
    """A picture of a device's newest measurement.

    Attributes:
        bgra: Four bytes a pixel, rows from the top left.
        scale: The meaning of its colours or rings in metres; None for a camera's picture.
    """

    bgra: bytes
    width: int
    height: int
    scale: str | None = None


def _of_camera(device: Any) -> Picture:
    return Picture(*image_of(device))


def _of_range_finder(device: Any) -> Picture:
    from webots_mcp.bridge.range_pictures import draw_depths  # only here: seldom needed

    canvas, scale = draw_depths(device)
    return Picture(canvas.bgra, canvas.width, canvas.height, scale)


def _of_lidar(device: Any) -> Picture:
    from webots_mcp.bridge.range_pictures import draw_from_above

    canvas, scale = draw_from_above(device)
    return Picture(canvas.bgra, canvas.width, canvas.height, scale)


# By class name in Webots' `controller` package; without a name asked for, the first kind is chosen.
_PICTURES: Final[dict[str, Callable[[Any], Picture]]] = {
    "Camera": _of_camera,
    "RangeFinder": _of_range_finder,
    "Lidar": _of_lidar,
}


def take_picture(device: Any) -> Picture:
    """The picture of a device that `find_pictured` found.

    Raises:
        CommandRefusedError: It has none yet.
    """
    return _PICTURES[type(device).__name__](device)


def find_pictured(robot: Any, name: str) -> Any:
    """The enabled device of that name, or (for "") the first one: cameras come first.

    Raises:
        InvalidInputError: There is no such device, or it takes no pictures.
        CommandRefusedError: It is disabled, or all are.
    """
    devices: dict[str, Any] = getattr(robot, "devices", None) or {}
    order = list(_PICTURES)
    pictured = {n: d for n, d in devices.items() if type(d).__name__ in _PICTURES}
    if name and name not in pictured:
        raise InvalidInputError(_no_such(name, devices.get(name), pictured))
    asked = [name] if name else sorted(pictured, key=lambda n: order.index(_kind(pictured[n])))
    enabled = [each for each in asked if pictured[each].getSamplingPeriod() > 0]
    if enabled:
        return pictured[enabled[0]]
    if not asked:
        raise CommandRefusedError("this robot has no camera, range finder or lidar")
    shown = ", ".join(f"{each!r} ({_kind(pictured[each])})" for each in asked[:_MOST_NAMED])
    raise CommandRefusedError(
        f"disabled: {shown}; call robot.getDevice({asked[0]!r}).enable(time_step) in the "
        "controller, and ask again after its next step"
    )


def _no_such(name: str, device: Any, pictured: dict[str, Any]) -> str:
    what = f"{name!r} is a {_kind(device)}" if device is not None else f"no device {name!r}"
    known = [f"{each!r} ({_kind(pictured[each])})" for each in pictured][:_MOST_NAMED]
    return f"{what}; devices with pictures: {', '.join(known) or 'none on this robot'}"


def _kind(device: Any) -> str:
    return type(device).__name__
