"""What clients and registries install is in their forms, of this version, and starts.

The forms are those of manifests of version 0.4 (github.com/modelcontextprotocol/mcpb) and of
server.json of 2025-12-11 (registry.modelcontextprotocol.io), as far as ours use them: what is not
named here is refused.
"""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlparse

import pytest

pytest.importorskip("hatchling", reason="hatchling is not installed")
import bundle
from webots_mcp import __version__
from webots_mcp.contract import DATA_DIR_VARIABLE
from webots_mcp.questions import all_questions
from webots_mcp.setup.client_entries import is_ours

CHECKOUT = Path(__file__).parents[1]
SOURCE = "https://github.com/robots/webots-mcp"
README = (CHECKOUT / "README.md").read_text("utf-8")
TEXT: dict[str, Any] = {"type": "string", "minLength": 1}
TEXTS: dict[str, Any] = {"type": "array", "items": TEXT}
WEB: dict[str, Any] = {"type": "string", "pattern": r"^https://[^\s/]+/\S*$"}


def form(members: dict[str, Any], /, **optional: Any) -> dict[str, Any]:
    """An object with these members, perhaps the optional ones, and no others."""
    return {
        "type": "object", "properties": members | optional, "required": list(members),
        "additionalProperties": False,
    }  # fmt: skip


MANIFEST = form(
    {
        "manifest_version": {"const": "0.4"},
        "name": TEXT,
        "version": {"type": "string", "pattern": r"^\d+\.\d+\.\d+$"},
        "description": TEXT,
        "author": form({"name": TEXT}),
        "server": form(
            {
                "type": {"enum": ["python", "node", "binary", "uv"]},
                "entry_point": TEXT,
                "mcp_config": form(
                    {"command": TEXT},
                    args=TEXTS,
                    env={"type": "object", "additionalProperties": TEXT},
                ),
            }
        ),
    },
    display_name=TEXT,
    tools={"type": "array", "items": form({"name": TEXT}, description=TEXT)},
    keywords=TEXTS,
    license=TEXT,
    compatibility=form(
        {},
        platforms={"type": "array", "items": {"enum": ["darwin", "win32", "linux"]}},
        runtimes=form({}, python=TEXT),
    ),
    user_config={
        "type": "object",
        "additionalProperties": form(
            {
                "type": {"enum": ["string", "number", "boolean", "directory", "file"]},
                "title": TEXT,
                "description": TEXT,
            },
            required={"type": "boolean"},
        ),
    },
)
SERVER = form(
    {
        "name": {"type": "string", "pattern": "^[a-zA-Z0-9.-]+/[a-zA-Z0-9._-]+$"},
        "description": {"type": "string", "minLength": 1, "maxLength": 100},
        "version": {"type": "string", "maxLength": 255, "not": {"const": "latest"}},
    },
    **{"$schema": WEB},
    title={"type": "string", "minLength": 1, "maxLength": 100},
    repository=form({"url": WEB, "source": {"const": "github"}}),
    packages={
        "type": "array",
        "items": form(
            {
                "registryType": {"const": "pypi"},
                "identifier": TEXT,
                "version": TEXT,
                "transport": form({"type": {"const": "stdio"}}),
            },
            runtimeHint={"const": "uvx"},
            packageArguments={
                "type": "array",
                "items": form({"type": {"const": "positional"}, "value": TEXT}),
            },
            environmentVariables={
                "type": "array",
                "items": form(
                    {"name": TEXT},
                    description=TEXT,
                    format={"enum": ["string", "number", "boolean", "filepath"]},
                    isRequired={"type": "boolean"},
                ),
            },
        ),
    },
)


@pytest.fixture
def unpacked(tmp_path: Path) -> Path:
    """The files of a bundle, whose wheel is not one."""
    wheel = tmp_path / f"webots_mcp-{__version__}-py3-none-any.whl"
    wheel.write_bytes(b"the wheel")
    with zipfile.ZipFile(bundle.write_bundle(wheel, tmp_path)) as packed:
        packed.extractall(tmp_path / "unpacked")
    return tmp_path / "unpacked"


@pytest.mark.slow
def test_the_manifest_of_the_bundle_is_valid_and_of_this_version(unpacked: Path) -> None:
    import jsonschema  # it takes a second, of one process

    manifest = json.loads((unpacked / "manifest.json").read_text("utf-8"))
    jsonschema.validate(manifest, MANIFEST)
    assert manifest["version"] == __version__
    assert {each["name"] for each in manifest["tools"]} <= {each.name for each in all_questions()}
    assert len(manifest["tools"]) > 20
    asked = set(re.findall(r"\$\{user_config\.(\w+)\}", json.dumps(manifest["server"])))
    assert asked == set(manifest["user_config"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**manifest, "icon": 1}, MANIFEST)


@pytest.mark.slow
def test_the_bundle_installs_the_wheel_that_is_in_it_and_starts_the_server(
    unpacked: Path, tmp_path: Path
) -> None:
    wanted: Any = bundle.TOML.loads((unpacked / "pyproject.toml").read_text("utf-8"))
    assert wanted["project"]["dependencies"] == ["webots-mcp"]
    wheel = wanted["tool"]["uv"]["sources"]["webots-mcp"]["path"]
    assert (unpacked / wheel).read_bytes() == b"the wheel"

    manifest = json.loads((unpacked / "manifest.json").read_text("utf-8"))["server"]
    variables = {
        name: value.replace("${user_config.project}", str(tmp_path))
        for name, value in manifest["mcp_config"]["env"].items()
    }
    assert variables == {DATA_DIR_VARIABLE: f"{tmp_path}/mcp_data"}
    started = subprocess.run(
        [sys.executable, manifest["entry_point"]], cwd=unpacked, input=b"", check=False,
        env={**os.environ, "PYTHONPATH": str(CHECKOUT), **variables}, capture_output=True,
    )  # fmt: skip
    assert started.returncode == 0, started.stderr


@pytest.mark.parametrize("source", [SOURCE, f"{SOURCE}.git", f"{SOURCE}/"])
def test_server_json_is_valid_of_this_version_and_of_the_name_that_the_index_shows(
    source: str,
) -> None:
    import jsonschema  # it takes a second, of one process

    from hatch_build import Readme

    server = bundle.server_of(source)
    jsonschema.validate(server, SERVER)
    assert {server["version"], *(each["version"] for each in server["packages"])} == {__version__}
    metadata: dict[str, Any] = {"urls": {"Source": source}}
    Readme(str(CHECKOUT), {}).update(metadata)
    assert metadata["readme"]["text"].endswith(f"\n<!-- mcp-name: {server['name']} -->\n")
    assert server["name"] == "io.github.robots/webots-mcp"


def test_a_repository_elsewhere_has_no_name_in_the_registry() -> None:
    with pytest.raises(ValueError, match="no repository on GitHub"):
        bundle.server_of("https://code.example/robots/webots-mcp")


def test_each_button_of_the_readme_enters_our_server_for_the_open_folder() -> None:
    links = re.findall(r"\]\((https://[^)\s]*install[^)\s]*)\)", README)
    cursor, code = (parse_qs(urlparse(str(each)).query) for each in links)
    assert [urlparse(str(each)).netloc for each in links] == ["cursor.com", "insiders.vscode.dev"]
    assert cursor["name"] == code["name"] == ["webots"]
    entries = [json.loads(base64.b64decode(cursor["config"][0])), json.loads(code["config"][0])]
    for entry in entries:
        assert is_ours(entry)
        assert entry["args"] == ["serve", "--data-dir", "${workspaceFolder}/mcp_data"]
