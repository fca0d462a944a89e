"""The names of the topics of an MCAP file."""

from __future__ import annotations

import re
from itertools import chain, count
from typing import Final

from webots_mcp.plugins.formats.contents import Contents
from webots_mcp.store.run_rows import StoredImage

WORLD_FRAME: Final = "world"


class Topics:
    """The names of the topics of a range.

    They are /ROBOT/state, /ROBOT/pose, /ROBOT/way, /ROBOT/camera/DEVICE, /ROBOT/screenshot,
    /ROBOT/log, /ROBOT/events and /ROBOT/commands; of several runs /run_ID/ROBOT/.... If two devices
    would have the same name, the second is called NAME_2.
    """

    def __init__(self, contents: Contents) -> None:
        self._devices: dict[str, str] = {}
        devices = {image.device for image in contents.images() if image.device}
        for device in sorted(devices, key=lambda each: (_named(each) != each, each)):
            self._device(device)  # Names that can stay as they are come first.
        self._robot = _named(contents.wanted.robot)
        self._several = len(contents.run_ids) > 1

    def frame(self, run_id: int) -> str:
        """Return the coordinate frame of the robot, which its topics begin with."""
        return f"run_{run_id}/{self._robot}" if self._several else self._robot

    def topic(self, run_id: int, name: str) -> str:
        """Return the topic with this name."""
        return f"/{self.frame(run_id)}/{name}"

    def image(self, image: StoredImage) -> str:
        """Return the topic of a picture. Pictures of a camera are in one topic."""
        name = f"camera/{self._device(image.device)}" if image.device else image.kind
        return self.topic(image.run_id, name)

    def _device(self, name: str) -> str:
        """Return the unique name of a device, whose first picture may just have arrived."""
        if name not in self._devices:
            plain, taken = _named(name), self._devices.values()
            numbered = (f"{plain}_{number}" for number in count(2))
            free = (each for each in chain([plain], numbered) if each not in taken)
            self._devices[name] = next(free)
        return self._devices[name]


def _named(name: str) -> str:
    # Message paths accept these characters without quotes.
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)
