"""The skills of the plugin in a project, and the lines of its AGENTS.md that name them.

The plugin is in the form of Claude Code: `plugin/skills/NAME/SKILL.md`. What is written ends with
a mark that holds a digest of it: what differs from its digest was changed by the user, and stays.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from webots_mcp.setup.file_change import FileChange, read

PLUGIN: Final = Path(__file__).parent / "plugin"


class ManagedText(NamedTuple):
    """A text of ours in a file of the project: the whole file, or some lines of it."""

    file: Path
    text: str
    is_whole: bool

    def plan(self) -> tuple[FileChange, str | None]:
        """Return the change that brings the text up to date, and what there is to know about it.

        Raises:
            OSError: The file cannot be read.
            UnicodeError: It is not in UTF-8.
        """
        before = read(self.file)
        held = (before or b"").decode("utf-8")
        begin_text = "<!-- webots-mcp: its lines begin here -->"
        edges = (r"\A", r"\Z") if self.is_whole else (rf"{begin_text}\r?\n", "")
        ours_text = r"(?s){}(.*?)<!-- webots-mcp ([0-9a-f]{{16}}): [^>\n]*-->(?:\r?\n)?{}"
        ours = re.search(ours_text.format(*edges), held)
        begin, end = (
            "" if self.is_whole else f"{begin_text}\n",
            (
                f"<!-- webots-mcp {_digest(self.text)}: updated by 'webots-mcp init --skills' "
                "until you change it -->\n"
            ),
        )
        line_end = "\r\n" if "\r\n" in held else "\n"
        wanted = f"{begin}{self.text}{end}".replace("\n", line_end)
        if not held.strip():
            after = wanted
        elif ours is not None and _digest(ours[1].replace("\r\n", "\n")) == ours[2]:
            after = held[: ours.start()] + wanted + held[ours.end() :]
        elif self.is_whole or begin_text in held:
            what = "the file" if self.is_whole else "what stands between its marks"
            return FileChange(self.file, before, held.encode()), (
                f"it is kept, as you wrote or changed it: remove {what} to get that of this version"
            )
        else:
            apart = line_end if held.endswith("\n") else 2 * line_end
            after = f"{held}{apart}{wanted}"
        return FileChange(self.file, before, after.encode()), None


def skill_files() -> list[Path]:
    """Return the page of each skill, by name."""
    return sorted(PLUGIN.glob("skills/*/SKILL.md"))


def managed_texts(project: Path) -> Iterator[ManagedText]:
    """What a project gets: each skill, and the lines that name them for clients without skills."""
    lines = list[str]()
    for page in skill_files():
        text = page.read_text("utf-8")
        place = Path(".claude", "skills", page.parent.name, page.name)
        yield ManagedText(project / place, text, is_whole=True)
        if named := re.match(r"---\nname: (\S+)\ndescription: (.+?\.) ", text):
            lines.append(f"- `{place.as_posix()}`: {named[2]}\n")
    head = (
        "## Webots\n\nThe MCP server `webots` and the command `webots-mcp` read what the robots of "
        "this project record,\nand steer the simulation. Before you do one of these, read its page:"
    )
    yield ManagedText(project / "AGENTS.md", f"{head}\n\n{''.join(lines)}", is_whole=False)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
