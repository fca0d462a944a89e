"""How the command line and an assistant get the faults of a world."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path

import anyio
import pytest
from mcp import Client
from mcp.types import CallToolResult

from tests.lint.worlds import write_world
from webots_mcp.answers.shortening import compact_json, tokens_in
from webots_mcp.answers.summaries import summary_of
from webots_mcp.cli import main
from webots_mcp.database.connection import connect
from webots_mcp.database.schema import create_schema
from webots_mcp.lint import RULES, lint_world
from webots_mcp.questions.lint_world import lint_answer, lint_in_short
from webots_mcp.server.mcp_server import create_server

FAULTY = "Solid { physics Physics { mass 1 inertiaMatrix [ 1 1 -1 0 0 0 ] } }"
NOTED = 'Solid { name "a" } Solid { name "a" }'


@pytest.mark.parametrize(("nodes", "code"), [("", 0), (NOTED, 0), (FAULTY, 1), ("Solid {", 2)])
def test_the_exit_code_says_whether_there_is_an_error(
    tmp_path: Path, nodes: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lint", str(write_world(tmp_path, nodes))]) == code
    assert "w.wbt: " in capsys.readouterr().out


def test_json_has_every_fault_with_its_reason_page_and_fix(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lint", str(write_world(tmp_path, FAULTY)), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    fault = answer["faults"][0]
    assert fault["path"].endswith(".physics.inertiaMatrix")
    assert fault["page"].startswith("https://cyberbotics.com/doc/")
    assert all(fault[name] for name in ("what", "why", "fix", "file", "line"))
    assert set(answer["verdicts"]) == set(RULES)


def test_notes_are_listed_unless_a_severity_is_chosen(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    world = str(write_world(tmp_path, NOTED))
    main(["lint", world])
    assert "have the name 'a'" in capsys.readouterr().out
    main(["lint", world, "--severity", "warning"])
    out = capsys.readouterr().out
    assert "have the name 'a'" not in out
    assert "1 note" in out


@pytest.mark.parametrize("name", ["missing.wbt", "notes.txt"])
def test_what_is_no_world_file_is_refused_with_an_example(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["lint", str(tmp_path / name)]) == 2
    assert "webots-mcp lint worlds/arena.wbt" in capsys.readouterr().err


def test_an_answer_to_a_model_stays_short_and_counts_what_it_leaves_out(tmp_path: Path) -> None:
    long = "x" * 3_000
    nodes = "\n".join(f'Solid {{ name "{long}{i}" physics Physics {{ }} }}' for i in range(300))
    answer = lint_answer(lint_world(write_world(tmp_path, nodes)))
    answer.summary = summary_of(answer)
    text = compact_json(answer.model_dump(mode="json", exclude_none=True))
    assert tokens_in(text) <= 2_000
    assert answer.counts is not None
    assert answer.counts["warnings"] >= 300
    assert "are shown" in (answer.hint or "")
    assert (answer.summary or "").startswith("w.wbt: ")


def test_world_information_names_the_number_and_the_worst(tmp_path: Path) -> None:
    world = write_world(tmp_path, FAULTY + NOTED)
    short = lint_in_short(str(world)) or {}
    assert (short["errors"], short["notes"]) == (1, 1)
    assert short["worst"].startswith("error: The principal moments")
    assert tokens_in(compact_json(short)) <= 150
    world.write_text("#VRML_SIM R2023b utf8\nWorldInfo { }\n", "utf-8")
    assert lint_in_short(str(world)) == {"errors": 0}


@pytest.mark.parametrize("world", ["/nowhere/w.wbt", "w.wbt", "\x00.wbt", ""])
def test_a_world_that_is_elsewhere_is_not_searched(world: str) -> None:
    assert lint_in_short(world) == {"not_searched": "the world file is not on this machine"}


def test_a_run_without_a_world_says_nothing_of_it() -> None:
    assert lint_in_short(None) is None


def test_an_assistant_may_ask_about_worlds_of_the_project_only(tmp_path: Path) -> None:
    plant, visitor = tmp_path / "plant", tmp_path / "visitor"
    for project in (plant, visitor):
        (project / "controllers").mkdir(parents=True)
        (project / "worlds").mkdir()
        write_world(project, NOTED)
    data = plant / "mcp_data"
    with closing(connect(data / "webots.db", "writer", create=True)) as connection:
        create_schema(connection)

    async def ask(world: str) -> CallToolResult:
        async with Client(create_server(data / "webots.db", data)) as client:
            return await client.call_tool("webots_lint_world", {"world": world})

    inside = anyio.run(ask, "worlds/w.wbt")
    assert inside.structured_content is not None
    assert inside.structured_content["counts"]["notes"] == 1
    assert not anyio.run(ask, str(plant / "worlds" / "w.wbt")).is_error
    for outside in (str(visitor / "worlds" / "w.wbt"), "../visitor/worlds/w.wbt"):
        assert anyio.run(ask, outside).is_error
