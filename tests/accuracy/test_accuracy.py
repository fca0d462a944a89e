"""The page of accuracy is whole, is what the command makes, and knows all that the code has."""

from __future__ import annotations

import re
from itertools import pairwise, product
from pathlib import Path

import pytest

from tests.accuracy import comparing
from tests.accuracy.__main__ import PARTS, SHOWN, figures, page_of, situations, stored
from tests.accuracy.page import DETAILS, FIGURES, PAGE, README, Part, share
from tests.benchmarks.core import Bench
from tests.cases import rates
from tests.cases.public import PUBLIC, labels
from tests.judging.checks.labelled import FAULTS, WRITTEN
from webots_mcp.judging.checks.check_run import CHECKS
from webots_mcp.judging.detection.event_kinds import kind_names

PAGE_TEXT = PAGE.read_text("utf-8")
DETAILS_OF = stored()
TINY = 0.01
SAMPLED = ("cases", "comparisons")  # parts of which a small run measures a few lines


def test_the_page_is_made_of_all_parts_and_nothing_else() -> None:
    assert {file.stem for file in DETAILS.glob("*.md")} == {part.name for part in PARTS}
    assert page_of(DETAILS_OF) == PAGE_TEXT
    for part in PARTS:
        details = DETAILS_OF[part.name]
        assert details.startswith(f"# {part.title}\n")
        assert re.search(r"(?m)^\*Measured on 20\d\d-\d\d-\d\d in \d+ s on .+\*$", details)


def test_the_page_begins_with_the_public_situations_and_names_those_that_are_missed() -> None:
    details = DETAILS_OF["cases"]
    rows = re.findall(r"(?m)^\| .+\(\[report\]\(.+\)\) \| -?\d+ \| (-?\d+) \|$", details)
    _, _, *texts = situations(details)
    missed = re.findall(r"(?m)^- .+: (-?\d+)$", texts[-1]) if texts else []
    assert sorted(missed) == sorted(each for each in rows if each != "2")
    assert PAGE_TEXT.index("healthy robots of public reports") < PAGE_TEXT.index("## All figures")


def test_the_page_knows_every_kind_of_event_every_check_and_every_fault() -> None:
    assert set(re.findall(r"`(\w+)`", DETAILS_OF["events"])) >= set(kind_names())
    cells = {cell for row in re.findall(r"(?m)^\|.+\|$", DETAILS_OF["checks"])
             for cell in row.strip("| ").split(" | ")}  # fmt: skip
    assert cells >= {*FAULTS, *WRITTEN, *(check.name for check in CHECKS)}


def test_the_readme_shows_four_figures_of_the_page() -> None:
    (shown,) = FIGURES.findall(README.read_text("utf-8"))
    assert shown == figures(DETAILS_OF)
    assert len(shown.splitlines()) == len(SHOWN) == 4
    assert "(docs/accuracy.md)" in README.read_text("utf-8")


def test_the_page_of_situations_has_each_public_one_and_each_rate_of_each_fault() -> None:
    rows = re.findall(r"(?m)^\| (.+) \|$", DETAILS_OF["cases"])
    linked = [row.split(" | ")[0] for row in rows if "([report](" in row]
    assert [each.rpartition("](")[2].removesuffix("))") for each in linked] == [
        labels()[name]["source"] for name in PUBLIC
    ]
    rated = [tuple(row.split(" | ")[:2]) for row in rows if row.startswith("`")]
    assert rated == [
        (f"`{name}`", f"{1000 * each:g} ms")
        for name, each in product(rates.FAULTS, rates.INTERVALS_S)
    ]


def test_the_page_of_comparisons_has_each_kind_of_equal_groups() -> None:
    rows = re.findall(r"(?m)^\| (\d+) \+ (\d+) (.+?) \|", DETAILS_OF["comparisons"])
    assert [(kind, (int(before), int(after))) for before, after, kind in rows] == [
        *product(comparing.KINDS.values(), comparing.EQUAL)
    ]


def form(section: str) -> dict[str, list[str]]:
    """What the lines of its tables are about, by the heads of the tables."""
    tables, head = dict[str, list[str]](), ""
    rows = re.findall(r"(?m)^\| (.+) \|$", section)
    for row, after in pairwise([*rows, ""]):
        if after.startswith("---"):
            head = row
            tables[head] = []
        elif not row.startswith("---"):
            tables[head].append(row.split(" | ")[0])
    return tables


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_part_comes_out_in_the_form_that_the_page_has(part: Part, tmp_path: Path) -> None:
    """Its figures are those of the day and the machine; nothing is asked of them."""
    if part.name in ("survival", "loop"):
        pytest.importorskip("mcap", reason="the extra 'mcap' is not installed")
        pytest.importorskip("rerun.chunk", reason="the extra 'rerun' is not installed")
    made = part.measured(Bench(tmp_path, TINY, lambda text: None))
    told, stored = form(made), form(DETAILS_OF[part.name])
    assert [*told] == [*stored], f"python -m tests.accuracy {part.name}"
    for head, lines in told.items():
        if part.name in SAMPLED:
            others = iter(stored[head])  # which are gone through once: the order counts
            assert lines and all(line in others for line in lines), head
        else:
            assert lines == stored[head], f"python -m tests.accuracy {part.name}"


def test_a_share_has_the_interval_of_the_textbook() -> None:
    assert share(0, 100) == "0 % (0 to 3.7)"
    assert share(5, 10) == "50 % (23.7 to 76.3)"
    assert share(0, 0) == "-"
