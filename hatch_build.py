"""What a package has of the checkout: the README with other links, and the documentation."""

import re
from functools import partial
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

_PICTURE = re.compile(r"(?m)^!\[[^\]]*\]\((?!https?:)([^)\s]+)\)\n+")
_GITHUB = re.compile(r"https://github\.com/([\w.-]+)/([\w.-]+?)(?:\.git)?/?")
PLACEHOLDER = "OWNER"  # stands in [project.urls] of pyproject.toml until a release
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\((?!https?:|#)([^)\s]+)\)")


class Readme(MetadataHookInterface):
    """Makes the links absolute, by `Source` of `[project.urls]`, and adds the registry's line.

    By that line the registry of MCP servers knows whose the package is.
    """

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field `readme`."""
        text = (Path(self.root) / "README.md").read_text("utf-8")
        source = source_of(metadata.get("urls", {}))
        shown = with_absolute_links(text, source)
        if source is not None and _GITHUB.fullmatch(source):
            shown += f"\n<!-- mcp-name: {registry_name(source)} -->\n"
        metadata["readme"] = {"content-type": "text/markdown", "text": shown}


class Documentation(BuildHookInterface[Any]):
    """Adds the pages to the wheel, where `webots-mcp help` finds them."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add each page; an editable installation reads those of the checkout."""
        pages = sorted((Path(self.root) / "docs").glob("*.md"))
        build_data["force_include"] |= {str(p): f"webots_mcp/docs/{p.name}" for p in pages}


def source_of(urls: dict[str, str]) -> str | None:
    """Return the address of the repository; None if there is none, or a placeholder."""
    source = urls.get("Source")
    return None if source is None or PLACEHOLDER in source else source


def with_absolute_links(text: str, source: str | None) -> str:
    """The text with links that lead to a repository; without one they are texts, and pictures go.

    Args:
        text: Markdown with links relative to the checkout.
        source: The address of the repository on GitHub.
    """
    if source is None:
        return _LINK.sub(r"\1", _PICTURE.sub("", text))
    at = source.rstrip("/")
    text = _PICTURE.sub(partial(_moved, f"{at}/raw/HEAD/"), text)
    return _LINK.sub(partial(_moved, f"{at}/blob/HEAD/"), text)


def registry_name(source: str) -> str:
    """What the registry of MCP servers calls the server of a repository on GitHub.

    Raises:
        ValueError: The address is no repository there.
    """
    found = _GITHUB.fullmatch(source)
    if found is None:
        raise ValueError(f"Source is no repository on GitHub: {source}")
    return f"io.github.{found[1]}/{found[2]}"


def _moved(address: str, link: re.Match[str]) -> str:
    whole, target = link[0], link[link.re.groups]
    return whole.replace(f"]({target})", f"]({address}{target})")
