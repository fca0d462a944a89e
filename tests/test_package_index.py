"""What the package index shows of the README leads somewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="hatchling is not installed")
from hatch_build import PLACEHOLDER, Readme, source_of, with_absolute_links

CHECKOUT = Path(__file__).parents[1]
SOURCE = "https://code.example/robots/webots-mcp"
TEXT = "[a](docs/a.md#b) [c](https://c.example) [d](#e)\n\n![f](docs/f.png)\n\nend\n"


def shown(urls: dict[str, str]) -> str:
    metadata = {"name": "webots-mcp", "urls": urls}
    Readme(str(CHECKOUT), {}).update(metadata)
    return metadata["readme"]["text"]  # type: ignore[index]


def targets(text: str) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", text)


def test_links_lead_to_the_repository_where_one_is_named() -> None:
    assert targets(with_absolute_links(TEXT, f"{SOURCE}/")) == [
        f"{SOURCE}/blob/HEAD/docs/a.md#b", "https://c.example", "#e",
        f"{SOURCE}/raw/HEAD/docs/f.png",
    ]  # fmt: skip


def test_without_a_repository_links_are_texts_and_pictures_are_left_out() -> None:
    assert with_absolute_links(TEXT, None) == "a [c](https://c.example) [d](#e)\n\nend\n"


@pytest.mark.parametrize("source", [None, f"https://github.com/{PLACEHOLDER}/webots-mcp", SOURCE])
def test_no_link_of_the_readme_is_relative(source: str | None) -> None:
    found = targets(shown({"Source": source} if source else {}))
    assert all(target.startswith("https://") for target in found), found
    assert not any(PLACEHOLDER in target for target in found)
    assert any(target.startswith(SOURCE) for target in found) == (source == SOURCE)


def test_a_release_has_addresses_in_place_of_the_placeholders() -> None:
    """A release closes the section "Unreleased" of the changelog, see CONTRIBUTING.md."""
    urls = re.findall(r'(?m)^(\w+) = "(https://\S+)"$', (CHECKOUT / "pyproject.toml").read_text())
    assert [name for name, _ in urls] == ["Source", "Documentation", "Issues", "Changelog"]
    placeholders = {PLACEHOLDER in address for _, address in urls}
    assert len(placeholders) == 1, "some are filled in, some are not"
    if not (CHECKOUT / "CHANGELOG.md").read_text("utf-8").count("\n## Unreleased\n"):
        assert placeholders == {False}, "fill in [project.urls] of pyproject.toml"
        assert source_of(dict(urls)) is not None
        readme = (CHECKOUT / "README.md").read_text("utf-8")
        assert PLACEHOLDER not in readme, "fill in the address to clone"


def test_the_readme_is_whole_but_for_its_links() -> None:
    plain = re.compile(r"\]\([^)]*\)|[\[\]!]")
    readme = (CHECKOUT / "README.md").read_text("utf-8")
    assert plain.sub("", shown({"Source": SOURCE})) == plain.sub("", readme)


@pytest.mark.slow
def test_a_wheel_has_each_page_of_the_documentation_where_the_help_finds_it(
    tmp_path: Path,
) -> None:
    line = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(line, cwd=CHECKOUT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = [Path(name) for name in archive.namelist()]
        archive.extractall(tmp_path / "installed")
    pages = {name.name for name in held if name.parent == Path("webots_mcp/docs")}
    assert pages == {file.name for file in (CHECKOUT / "docs").glob("*.md")}
    done = subprocess.run(
        [sys.executable, "-m", "webots_mcp", "help", "scores"],
        cwd=tmp_path / "installed", capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(tmp_path / "installed")},
    )  # fmt: skip
    assert done.stdout.startswith("## Scores\n"), done.stderr
