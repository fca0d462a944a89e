"""`webots-mcp help` prints the documentation, which is installed with the package."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import webots_mcp
from webots_mcp.cli import main
from webots_mcp.cli.help_pages import page_files, sections_about, titles, with_topics_for_links
from webots_mcp.setup.doctor import all_checks

PACKAGE = Path(webots_mcp.__file__).parent
DOCS = Path(__file__).parents[2] / "docs"
NAMED_TOPIC = re.compile(r"webots-mcp help ([a-z][\w-]*(?: [a-z][a-z-]+)?)(?=['`)])")


def messages() -> Iterator[tuple[str, str]]:
    """Each text of the package that somebody may read, with its place."""
    for file in sorted(PACKAGE.rglob("*")):
        if file.suffix == ".py":
            for node in ast.walk(ast.parse(file.read_text("utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield f"{file.name}:{node.lineno}", node.value
        elif file.suffix in (".sql", ".h", ".toml", ".js") or file.name == "SKILL.md":
            yield file.name, file.read_text("utf-8")


@pytest.mark.slow
def test_no_message_names_a_page_as_a_file() -> None:
    assert [place for place, text in messages() if re.search(r"\bdocs/[\w-]+\.md", text)] == []


@pytest.mark.slow
def test_each_topic_that_a_message_names_is_a_page_or_a_heading_of_it() -> None:
    named = {topic for _, text in messages() for topic in NAMED_TOPIC.findall(text)}
    assert {"standin", "policy", "pool"} <= named
    for topic in named - {"stuck"}:
        assert sections_about(topic.split())[0].topic == topic


def test_each_check_of_the_doctor_names_its_section() -> None:
    for check in all_checks(with_server=True):
        topic = check.page.removeprefix("webots-mcp help ").split()
        assert sections_about(topic)[0].title == check.name


def test_without_a_topic_it_lists_each_page(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help"]) == 0
    listed = re.findall(r"(?m)^  (\S+) +(.+)$", capsys.readouterr().out)
    assert sorted(name for name, _ in listed) == sorted(
        file.stem for file in DOCS.glob("*.md") if file.stem != "index"
    )
    assert dict(listed) == titles()


def test_a_page_is_printed_whole(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", "conditions"]) == 0
    out = capsys.readouterr().out
    for heading in re.findall(r"(?m)^##+ .+$", (DOCS / "conditions.md").read_text("utf-8")):
        assert heading in out


def test_a_symptom_is_answered_by_its_section_with_others_to_see(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["help", "stuck", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert "stuck" in answer["text"].splitlines()[0].lower()
    assert answer["see_also"]
    for topic in answer["see_also"]:
        assert sections_about(topic.split())[0].topic == topic


@pytest.mark.parametrize(
    ("topic", "found"),
    [
        ("docs/trials.md", "trials"),
        ("data folder", "troubleshooting data-folder"),
        ("score", "trials scores"),
        ("trials cluster", "trials on-a-cluster"),
    ],
)
def test_a_topic_is_a_file_a_heading_or_words_of_one(topic: str, found: str) -> None:
    assert sections_about(topic.split())[0].topic == found


def test_a_topic_that_no_page_has_is_refused_with_near_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["help", "condishions"]) == 2
    assert "conditions" in capsys.readouterr().err


def test_a_command_that_no_page_is_about_is_explained_by_its_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webots_mcp.cli.help_pages._ranked", list)
    assert main(["help", "prune"]) == 0
    assert "--dry-run" in capsys.readouterr().out


def test_links_name_the_topic_to_ask_for() -> None:
    text = "[a run](trials.md#scores) [pool](pool.md) [x](https://x.example) ![path](a.png)"
    assert with_topics_for_links(text) == (
        "a run (help trials scores) pool [x](https://x.example) (picture: path)"
    )


def test_all_links_between_pages_lead_to_a_section() -> None:
    for file in page_files().values():
        text = with_topics_for_links(file.read_text("utf-8"))
        for page, anchor in re.findall(r"\(help ([\w-]+)(?: ([\w-]+))?\)", text):
            wanted = [page, anchor] if anchor else [page]
            assert sections_about(wanted)[0].topic == " ".join(wanted), file


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")
def test_a_terminal_shows_it_rendered_and_a_pipe_gets_its_text() -> None:
    import pty

    command = [sys.executable, "-m", "webots_mcp", "help", "any-language", "limits"]
    piped = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert piped.startswith("## Limits\n")
    master, slave = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "80"}
    shown = b""
    with subprocess.Popen(command, stdout=slave, env=environment) as process:
        os.close(slave)
        while True:
            try:
                block = os.read(master, 65536)
            except OSError:  # Linux: the other end is closed
                break
            if not block:
                break
            shown += block
    os.close(master)
    assert process.returncode == 0
    assert "\x1b[" in shown.decode()
    assert "## Limits" not in shown.decode()
    lines = re.sub(r"\x1b\[[\d;]*m", "", shown.decode()).splitlines()
    assert max(map(len, lines)) <= 80
