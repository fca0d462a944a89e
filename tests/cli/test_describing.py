"""`webots-mcp signals`: listed, described and undone by a person."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main
from webots_mcp.contract import PROJECT_FILE


@pytest.fixture
def file(tmp_path: Path) -> Path:
    recorded = Recorded(tmp_path / "webots.db")
    recorded.robot().state(1.0, {"u": 0.5, "motors": {"left": 1.0}, "front_m": 1.0})
    recorded.close()
    return tmp_path / "webots.db"


def run(file: Path, *words: str) -> int:
    return main(["signals", *words, "--database", str(file)])


def test_a_signal_is_described_listed_and_undone(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = ("quantity=wheel speed", "role=commanded", "low=-6.5", "unit=rad/s")
    assert run(file, "--describe", "motors.left", *said) == 0
    shown = capsys.readouterr().out
    assert "wheel speed" in shown
    assert "declared with webots-mcp signals --describe" in shown
    assert run(file, "motors.*", "--json") == 0
    table = json.loads(capsys.readouterr().out)["signals"]
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    assert (row["meaning"], row["source"]) == ("commanded wheel speed, left", "declared")
    assert row["unit"] == "rad/s"
    assert run(file, "--undo", "motors.left") == 0
    assert "undone" not in capsys.readouterr().err
    assert run(file, "--meanings", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert not any("declared" in row for row in listed["signals"]["rows"])


def test_the_list_names_the_command_that_describes_what_is_unknown(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(file, "--meanings") == 0
    shown = capsys.readouterr().out
    assert "signals of unknown meaning are not judged" in shown
    assert "'webots-mcp signals --describe'" in shown


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--describe", "u", "--undo", "u"), "exclude each other"),
        (("--describe", "u"), "--describe needs FIELD=VALUE, such as quantity=speed"),
        (("--describe", "u", "speed"), "has no value. Write speed=VALUE"),
        (("--describe", "u", "kind=speed"), "unknown field 'kind'. Fields: quantity, role"),
        (("--describe", "u", "low=a"), "low"),
        (("--undo", "u", "v"), "--undo takes one signal"),
        (("--undo", "u"), "No meaning is declared for signal 'u'"),
        (("a", "b"), "Only one pattern is allowed"),
    ],
)
def test_what_is_typed_wrong_is_refused_with_what_to_type(
    file: Path, words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(file, *words) != 0
    assert said in capsys.readouterr().err


def test_a_rule_of_the_project_binds_a_person_too(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file.parent / PROJECT_FILE).write_text('[allow]\ntools = ["*", "!webots_describe_signals"]\n')
    assert run(file, "--describe", "u", "quantity=speed") != 0
    assert "webots_describe_signals is not allowed" in capsys.readouterr().err
