"""`webots-mcp init --observer` and its undoing, on real projects."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.test_init_command import project, run, snapshot
from webots_mcp.standin.in_process import DEFAULT_WORLD

pytestmark = pytest.mark.slow

__all__ = ["project"]

WORLD = "worlds/arena.wbt"
COPY = "worlds/arena_observed.wbt"
CONTROLLER = "controllers/mcp_observer/mcp_observer.py"


@pytest.fixture
def arena(project: Path) -> Path:
    (project / WORLD).write_bytes(DEFAULT_WORLD.read_bytes())
    return project


def test_a_copy_gets_the_observer_and_a_second_time_changes_nothing(arena: Path) -> None:
    before = snapshot(arena)
    ended = run("--observer", WORLD, cwd=arena)
    assert ended.returncode == 0, ended.stderr
    after = snapshot(arena)
    assert before.items() <= after.items()
    assert {COPY, CONTROLLER} <= after.keys() - before.keys()
    assert f"open {COPY} in Webots" in ended.stdout
    again = run("--observer", WORLD, cwd=arena)
    assert (again.returncode, snapshot(arena)) == (0, after)


def test_what_was_added_is_taken_away_again(arena: Path) -> None:
    before = snapshot(arena)
    run("--observer", WORLD, cwd=arena)
    refused = run("--undo", COPY, cwd=arena)
    assert refused.returncode == 2
    assert "--yes" in refused.stderr
    ended = run("--undo", COPY, "--yes", "--json", cwd=arena)
    assert {each["outcome"] for each in json.loads(ended.stdout)["files"]} == {"deleted"}
    assert snapshot(arena) == before
    assert not (arena / CONTROLLER).parent.exists()


def test_undo_leaves_no_empty_folder_in_a_project_of_worlds_alone(tmp_path: Path) -> None:
    (tmp_path / "worlds").mkdir()
    (tmp_path / WORLD).write_bytes(DEFAULT_WORLD.read_bytes())
    assert run("--observer", WORLD, cwd=tmp_path).returncode == 0
    assert (tmp_path / CONTROLLER).exists()
    assert run("--undo", COPY, "--yes", cwd=tmp_path).returncode == 0
    assert [each.name for each in tmp_path.iterdir()] == ["worlds"]


def test_in_place_changes_the_world_itself_and_undo_brings_it_back(arena: Path) -> None:
    world = (arena / WORLD).read_bytes()
    assert run("--observer", WORLD, "--in-place", cwd=arena).returncode == 0
    assert (arena / WORLD).read_bytes().startswith(world)
    assert not (arena / COPY).exists()
    assert run("--undo", WORLD, "--yes", cwd=arena).returncode == 0
    assert (arena / WORLD).read_bytes() == world


def test_a_copy_that_somebody_changed_is_not_written_over_unasked(arena: Path) -> None:
    run("--observer", WORLD, cwd=arena)
    (arena / COPY).write_bytes((arena / COPY).read_bytes().replace(b"ROVER", b"MINE"))
    before = snapshot(arena)
    ended = run("--observer", WORLD, cwd=arena)
    assert ended.returncode == 2
    assert "-DEF MINE" in ended.stdout
    assert snapshot(arena) == before
    assert run("--observer", WORLD, "--yes", cwd=arena).returncode == 0
    assert b"MINE" not in (arena / COPY).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--observer", "worlds/none.wbt"), "there is no world"),
        (("--in-place",), "--observer WORLD"),
        (("--observer", WORLD, "--undo", WORLD), "exclude each other"),
        (("--undo", WORLD, "--yes"), "no robot 'mcp_observer'"),
    ],
)
def test_what_cannot_be_done_is_refused(arena: Path, arguments: tuple[str, ...], said: str) -> None:
    before = snapshot(arena)
    ended = run(*arguments, cwd=arena)
    assert ended.returncode == 2
    assert said in ended.stderr
    assert snapshot(arena) == before


def test_an_extern_observer_needs_no_controller(arena: Path) -> None:
    ended = run("--observer", WORLD, "--extern", cwd=arena)
    assert "webots-mcp observe" in ended.stdout
    assert not (arena / CONTROLLER).exists()
