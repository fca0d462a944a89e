"""What installs webots-mcp, or what it lacks, is named by where it really is."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import webots_mcp
from webots_mcp.extras.requirements import (
    checkout,
    explain_extra,
    install_line,
    missing_requirements,
)

PACKAGE = Path(webots_mcp.__file__).parent
ASK = "from webots_mcp.extras.requirements import checkout; print(checkout())"


def installed_from(folder: Path, origin: dict[str, object]) -> str:
    """What a package says that pip put into a folder, and noted where it was from."""
    (folder / "webots_mcp" / "extras").mkdir(parents=True)
    for name in ("__init__.py", "extras/__init__.py", "extras/requirements.py"):
        text = (PACKAGE / name).read_text("utf-8") if name.endswith("requirements.py") else ""
        (folder / "webots_mcp" / name).write_text(text, "utf-8")
    about = folder / "webots_mcp-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: webots-mcp\nVersion: 1\n")
    (about / "direct_url.json").write_text(json.dumps(origin))
    line = [sys.executable, "-I", "-S", "-c", f"import sys; sys.path.insert(0, '{folder}'); {ASK}"]
    return subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip()


def test_in_a_checkout_it_is_installed_from_there() -> None:
    assert checkout() == str(PACKAGE.parent)


def test_what_was_installed_from_a_folder_is_installed_from_it_again(tmp_path: Path) -> None:
    source = tmp_path / "my checkout"
    source.mkdir()
    assert installed_from(tmp_path / "site", {"url": source.as_uri(), "dir_info": {}}) == str(
        source
    )


def test_what_was_installed_from_a_repository_names_it_with_its_commit(tmp_path: Path) -> None:
    origin: dict[str, object] = {
        "url": "https://host/x.git",
        "vcs_info": {"vcs": "git", "commit_id": "ab12"},
    }
    assert installed_from(tmp_path / "site", origin) == "git+https://host/x.git@ab12"


@pytest.mark.parametrize("origin", [{"url": "file:///no/such/folder", "dir_info": {}}, {}])
def test_where_it_came_from_is_left_to_the_reader_if_it_is_gone_or_unknown(
    tmp_path: Path, origin: dict[str, object]
) -> None:
    assert installed_from(tmp_path / "site", origin) == "CHECKOUT"


def test_an_extra_is_named_by_its_packages_not_by_a_name_on_an_index() -> None:
    told = explain_extra("a search", "search")
    assert told.startswith("a search needs optuna: ")
    assert (
        "'optuna" in told and "webots-mcp" not in told.partition(": ")[2].partition(" install ")[2]
    )
    assert missing_requirements() == []
    assert install_line(["a>=1"]).endswith("install 'a>=1'") or sys.platform == "win32"


@pytest.mark.parametrize(
    ("python", "newest"), [("3.10", "1.0.4"), ("3.11", "1.1.0"), ("3.13", "1.1.0")]
)
def test_the_newest_codec_that_a_python_may_get_has_a_wheel_for_it(
    python: str, newest: str
) -> None:
    """Of 1.1 there is none for 3.10, and pip would build it, which takes a Rust compiler."""
    lines = (PACKAGE.parent / "pyproject.toml").read_text("utf-8").splitlines()
    wanted = [Requirement(line.split('"')[1]) for line in lines if line.startswith('    "pcodec')]
    (ours,) = (
        each for each in wanted if each.marker and each.marker.evaluate({"python_version": python})
    )
    assert list(ours.specifier.filter(["1.0.0", "1.0.4", "1.1.0"]))[-1] == newest


def test_of_what_is_named_once_for_each_python_ours_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    new, old = "no-such-a>=2; python_version >= '3.11'", "no-such-a<2; python_version < '3.11'"

    def requires(_: str) -> list[str]:
        return [new, old]

    monkeypatch.setattr("importlib.metadata.requires", requires)
    assert missing_requirements() == [
        "no-such-a<2" if sys.version_info < (3, 11) else "no-such-a>=2"
    ]
