"""A report in a real browser without a network."""

from __future__ import annotations

import sqlite3
from functools import partial
from typing import Any

import pytest

from webots_mcp.plugins.report.making import Report

pytestmark = pytest.mark.slow
DRAWN = "() => [...document.querySelectorAll('[data-figure]')].every(each => each.figure)"
CURVES = """() => [...document.querySelectorAll('[data-figure]')]
    .flatMap(each => each.figure.data.curves ?? [])
    .map(curve => Math.max(...(curve.high ?? curve.mean)))"""
VIEW = """() => JSON.stringify(document.querySelector('[data-figure="signals 1"]').figure.view.x)"""


@pytest.fixture(scope="module")
def opened(chromium: Any, both: Report, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The report of two runs, with what went wrong and what was asked of a network."""
    file = tmp_path_factory.mktemp("report") / "both.html"
    file.write_bytes(both.html)
    context = chromium.new_context(offline=True, viewport={"width": 1280, "height": 900})
    page = context.new_page()
    page.wrong, page.asked = [], []
    page.on("pageerror", partial(_keep, page.wrong))
    page.on("console", partial(_note, page.wrong))
    page.on("request", partial(_ask, page.asked))
    page.goto(file.as_uri())
    page.wait_for_function(DRAWN, timeout=120_000)
    yield page
    context.close()


def _keep(wrong: list[str], error: Any) -> None:
    wrong.append(str(error))


def _note(wrong: list[str], said: Any) -> None:
    if said.type in ("error", "warning"):
        wrong.append(said.text)


def _ask(asked: list[str], request: Any) -> None:
    asked.append(request.url)


def test_it_opens_without_a_network_draws_what_was_recorded_and_zooms(
    opened: Any, both: Report, recording: sqlite3.Connection
) -> None:
    assert opened.wrong == []
    assert [url[:80] for url in opened.asked if not url.startswith(("file:", "data:"))] == []
    assert opened.locator("[data-figure]").count() == both.holds["figures"]

    (greatest,) = recording.execute(
        "SELECT max(json_extract(data, '$.battery_v')) FROM state WHERE run_id = 1"
    ).fetchone()
    assert any(abs(high - greatest) < 1e-9 for high in opened.evaluate(CURVES))

    before = opened.evaluate(VIEW)
    figure = opened.locator('[data-figure="signals 1"]')
    figure.scroll_into_view_if_needed()
    box = figure.bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
    opened.keyboard.down("Control")
    opened.mouse.wheel(0, -600)
    opened.keyboard.up("Control")
    opened.wait_for_function(f"before => ({VIEW})() != before", arg=before, timeout=30_000)


def test_the_values_of_all_are_told_at_the_pointer_and_a_click_hides_a_curve(opened: Any) -> None:
    figure = opened.locator('[data-figure="signals 1"]')
    figure.scroll_into_view_if_needed()
    box = figure.bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
    told = figure.locator(".told")
    told.wait_for()
    assert "battery_v 12." in told.inner_text()
    figure.locator('[data-hides="curve battery_v"]').click()
    assert not figure.locator('[data-part="curve battery_v"]').first.is_visible()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
    assert "battery_v" not in told.inner_text()


def test_pictures_are_seen(opened: Any) -> None:
    widths = opened.evaluate(
        "async () => { const all = [...document.querySelectorAll('.pictures img')];"
        "await Promise.all(all.map(each => each.decode()));"
        "return all.map(each => each.naturalWidth) }"
    )
    assert widths
    assert min(widths) > 0
