"""What a release brings besides the wheel: the .mcpb bundle of Claude Desktop, and server.json.

    python bundle.py dist/webots_mcp-VERSION-py3-none-any.whl

The bundle holds that wheel, so that it installs what was tested; the host's uv fetches what the
wheel needs. server.json, for the registry of MCP servers, names the package on the index. It is
written once `[project.urls]` of pyproject.toml names the repository as `Source`.
"""

from __future__ import annotations

import json
import sys
import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import anyio
from mcp.types import Tool

from hatch_build import registry_name, source_of
from webots_mcp import __version__
from webots_mcp.contract import DATA_DIR_VARIABLE, PROJECT_DATA_FOLDER
from webots_mcp.database.location import MemoryDatabase
from webots_mcp.server.mcp_server import create_server

TOML: Final[Any] = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
CHECKOUT: Final = Path(__file__).parent
PROJECT: Final = TOML.loads((CHECKOUT / "pyproject.toml").read_text("utf-8"))["project"]
_TITLE: Final = "Webots flight recorder"
_REGISTRY: Final = "https://static.modelcontextprotocol.io/schemas/2025-12-11/server.schema.json"
_SERVER: Final = """\
from webots_mcp.cli import main

raise SystemExit(main(["serve"]))
"""
_DEPENDS: Final = """\
[project]
name = "webots-mcp-bundle"
version = "{version}"
requires-python = "{python}"
dependencies = ["{name}"]

[tool.uv.sources]
{name} = {{ path = "{wheel}" }}
"""


def manifest_of(tools: list[Tool]) -> dict[str, Any]:
    """The manifest of the bundle, of version 0.4: the first that knows servers run by uv."""
    return {
        "manifest_version": "0.4",
        "name": PROJECT["name"],
        "display_name": _TITLE,
        "version": __version__,
        "description": PROJECT["description"],
        "author": {"name": PROJECT["authors"][0]["name"]},
        "server": {
            "type": "uv",
            "entry_point": "server.py",
            "mcp_config": {
                "command": "uv",
                "args": ["run", "--directory", "${__dirname}", "server.py"],
                "env": {DATA_DIR_VARIABLE: f"${{user_config.project}}/{PROJECT_DATA_FOLDER}"},
            },
        },
        "tools": [{"name": each.name, "description": each.title or ""} for each in tools],
        "keywords": PROJECT["keywords"],
        "license": PROJECT["license"],
        "compatibility": {
            "platforms": ["darwin", "linux", "win32"],
            "runtimes": {"python": PROJECT["requires-python"]},
        },
        "user_config": {
            "project": {
                "type": "directory",
                "title": "Webots project",
                "description": "The folder with worlds/ and controllers/ whose robots record.",
                "required": True,
            }
        },
    }


def server_of(source: str) -> dict[str, Any]:
    """`server.json` of a package whose repository is on GitHub.

    Raises:
        ValueError: It is not.
    """
    return {
        "$schema": _REGISTRY,
        "name": registry_name(source),
        "title": _TITLE,
        "description": PROJECT["description"],
        "version": __version__,
        "repository": {"url": source, "source": "github"},
        "packages": [
            {
                "registryType": "pypi",
                "identifier": PROJECT["name"],
                "version": __version__,
                "runtimeHint": "uvx",
                "transport": {"type": "stdio"},
                "packageArguments": [{"type": "positional", "value": "serve"}],
                "environmentVariables": [
                    {
                        "name": DATA_DIR_VARIABLE,
                        "description": "mcp_data in the Webots project, where its robots record",
                        "format": "filepath",
                        "isRequired": True,
                    }
                ],
            }
        ],
    }


def write_bundle(wheel: Path, folder: Path) -> Path:
    """Write the bundle of a wheel into a folder; returns its file.

    Raises:
        ValueError: The wheel is of another version.
    """
    if f"-{__version__}-" not in wheel.name:
        raise ValueError(f"{wheel} is not of version {__version__}")
    memory = MemoryDatabase()
    tools = anyio.run(create_server(memory, memory.data_dir).list_tools)
    memory.close()
    depends = _DEPENDS.format(
        name=PROJECT["name"],
        version=__version__,
        python=PROJECT["requires-python"],
        wheel=wheel.name,
    )
    file = folder / f"{PROJECT['name']}-{__version__}.mcpb"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as bundle:
        bundle.writestr("manifest.json", _text(manifest_of(tools)))
        bundle.writestr("pyproject.toml", depends)
        bundle.writestr("server.py", _SERVER)
        bundle.write(wheel, wheel.name)
        bundle.write(CHECKOUT / "LICENSE", "LICENSE")
    return file


def _text(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2) + "\n"


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    wheel = Path(sys.argv[1])
    print(write_bundle(wheel, wheel.parent))
    if source := source_of(PROJECT.get("urls", {})):
        file = wheel.with_name("server.json")
        file.write_text(_text(server_of(source)), "utf-8")
        print(file)
    else:
        print("no server.json: [project.urls] in pyproject.toml names no Source")
