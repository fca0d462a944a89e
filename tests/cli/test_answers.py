"""The answer of a tool as a person reads it."""

from __future__ import annotations

import pytest

from webots_mcp.cli.terminal import Display, answer_lines, set_display, table_lines

HEAD = {"robot": "rover", "run_id": 3, "sim_time_s": 1.5, "age_s": 0.02, "status": "running"}


def test_whom_and_when_it_is_about_stands_in_one_line() -> None:
    assert list(answer_lines(HEAD)) == ["rover, run 3, at 1.5 s, running, 0.02 s old"]


def test_that_line_too_is_wrapped_where_the_terminal_is_narrow() -> None:
    assert list(answer_lines(HEAD, width=30)) == [
        "rover, run 3, at 1.5 s,",
        "  running, 0.02 s old",
    ]


def test_short_members_stand_together_and_objects_by_themselves() -> None:
    answer = {**HEAD, "outcome": "done", "steps": 5, "route": "bridge",
              "result": {"mode": "pause", "pose": {"x": 1.0, "y": -0.25}}}  # fmt: skip
    assert list(answer_lines(answer))[1:] == [
        "outcome done, steps 5, route bridge",
        "result:",
        "  mode pause",
        "  pose: x 1, y -0.25",
    ]


def test_a_table_has_aligned_columns_and_says_how_many_rows_are_not_shown() -> None:
    rows = [["speed", 5.0, None], ["near", 0.35, None]] * 5
    answer = {"parameters": {"columns": ["name", "value", "unit"], "rows": rows}, "total": 10}
    assert list(answer_lines(answer, most_rows=6)) == [
        "parameters:",
        "  name   value",
        *["  speed      5", "  near    0.35"] * 3,
        "  ... and 4 more",
        "total 10",
    ]


def test_a_long_text_is_whole_and_wrapped_and_obeyed_by_no_terminal() -> None:
    words = " ".join(f"word{number}" for number in range(40))
    lines = list(answer_lines({"verdict": f"{words} \x1b[2J end"}))
    assert max(map(len, lines)) <= 100
    assert " ".join(line.strip() for line in lines) == f"verdict {words} \\x1b[2J end"


def test_each_of_several_objects_has_a_part_of_its_own() -> None:
    runs = [{"run_id": 1, "rows": 4}, {"run_id": 2, "rows": 6}]
    assert list(answer_lines({"runs": runs, "none": []})) == [
        "runs: run_id 1, rows 4",
        "runs: run_id 2, rows 6",
        "none []",
    ]


COLUMNS = [f"column{number}" for number in range(6)]
ROWS = [[f"2026-11-22T23:40:{row:02}Z", *(f"a{row} b c{n}" for n in range(5))] for row in (1, 2)]


@pytest.mark.parametrize("width", [20, 60, 80, 120])
def test_with_verbose_no_word_of_a_table_is_lost_however_narrow_the_terminal_is(width: int) -> None:
    set_display(Display(verbose=True))
    try:
        lines = list(table_lines(COLUMNS, ROWS, width))
    finally:
        set_display(Display())
    assert width < 24 or max(map(len, lines)) <= width
    told = {word.rstrip(",") for line in lines for word in line.split()}
    assert told == {*COLUMNS, *(word for row in ROWS for cell in row for word in cell.split())}


@pytest.mark.parametrize("width", [40, 60, 80])
def test_a_narrow_table_stays_a_table_and_names_the_columns_that_it_leaves_out(width: int) -> None:
    lines = list(table_lines(COLUMNS, ROWS, width))
    assert max(map(len, lines)) <= width
    shown, omitted = lines[0].split(), " ".join(lines).partition("not shown: ")[2]
    omitted_names = omitted.partition(" (--verbose")[0].replace(",", " ").split()
    assert [*shown, *reversed(omitted_names)] == COLUMNS or [*shown, *omitted_names] == COLUMNS
    assert len(lines) <= 2 * 2 + 3


def test_outcomes_stay_longer_than_other_columns() -> None:
    columns = ["id", "tool", "arguments", "outcome"]
    rows = [[1, "webots_simulation_control", "command step, steps 3, force false", "done"]]
    head = next(iter(table_lines(columns, rows, 48)))
    assert head.split() == ["id", "tool", "outcome"]


def test_a_terminal_shows_outcomes_in_colour_and_recorded_codes_spelled_out() -> None:
    rows = [["run", "failed"], ["step", "done"], ["\x1b[31mx", "done"]]
    lines = list(table_lines(["action", "outcome"], rows, 80, colour=True))
    assert "\x1b[1;31mfailed" in lines[1] and "\x1b[32mdone" in lines[2]
    assert "\\x1b[31mx" in lines[3]
