"""Where the files of PROTO nodes are: those of the world, of its project and of Webots."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Final

HOME_VARIABLE: Final = "WEBOTS_HOME"
_OF_WEBOTS: Final = re.compile(
    r"(?:webots://|https://raw\.githubusercontent\.com/cyberbotics/webots/[^/]+/)(projects/.+)"
)


class ProtoFiles:
    """The files of the PROTO nodes that a world names, found as Webots finds them."""

    def __init__(self, world: Path, urls: Mapping[str, str]) -> None:
        self._project = world.parent.parent / "protos"
        self._files: dict[str, Path] = {}
        self.urls: dict[str, str] = {}
        """URLs of PROTOs by name, from EXTERNPROTO."""
        self.note(urls, world.parent)

    def note(self, urls: Mapping[str, str], folder: Path) -> None:
        """Add the EXTERNPROTO lines of a file in this folder; the first of a name counts."""
        for name, url in urls.items():
            self.urls.setdefault(name, url)
            of_webots = _OF_WEBOTS.fullmatch(url)
            if of_webots and self.home:
                self._files.setdefault(name, self.home / of_webots[1])
            elif "://" not in url:
                self._files.setdefault(name, folder / url)

    def file_of(self, name: str) -> Path | None:
        """Return the file of a PROTO, which may not exist; None if there is none on this disk.

        A name that is declared with a URL is no other PROTO of the project.
        """
        if name in self.urls:
            return self._files.get(name)
        if "/" not in name and (self._project / f"{name}.proto").is_file():
            return self._project / f"{name}.proto"
        return self._installed.get(name)

    @cached_property
    def home(self) -> Path | None:
        """Return the folder of the installed Webots that contains `projects`."""
        home = Path(os.environ.get(HOME_VARIABLE) or "/nowhere")
        return next(
            (root for root in (home, home / "Contents") if (root / "projects").is_dir()), None
        )

    @cached_property
    def _installed(self) -> dict[str, Path]:
        """Return PROTO files of the installed Webots by name, for worlds without EXTERNPROTO."""
        files = (self.home / "projects").rglob("*.proto") if self.home else ()
        return {file.stem: file for file in files}
