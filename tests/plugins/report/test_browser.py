"""A report in a real browser without a network."""

from __future__ import annotations

import sqlite3
from functools import partial
from typing import Any

import pytest

from webots_mcp.plugins.report.make_report import Report

pytestmark = pytest.mark.slow
DRAWN = "() => [...document.querySelectorAll('[data-figure]')].every(each => each.figure)"
CURVES = """() => [...document.querySelectorAll('[data-figure]')]
    .flatMap(each => each.figure.data.curves ?? [])
    .map(curve => Math.max(...(curve.high ?? curve.mean)))"""
# The text with the least contrast to its ground (WCAG 2.2); translucent grounds are none of ours.
LEAST_CONTRAST = """() => {
    const parts = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = (text) => {
        const [r, g, b] = parts(text).slice(0, 3).map((each) => each / 255)
            .map((each) => each <= 0.04045 ? each / 12.92 : ((each + 0.055) / 1.055) ** 2.4);
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const ground = (each) => {
        for (; each; each = each.parentElement) {
            const found = getComputedStyle(each).backgroundColor;
            if ((parts(found)[3] ?? 1) > 0) return found;
        }
        return "rgb(255, 255, 255)";
    };
    let least = { ratio: 99 };
    for (const each of document.querySelectorAll("main :not(svg *)")) {
        const own = [...each.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
        if (!own || each.closest("svg, script")) continue;
        const [a, b] = [light(getComputedStyle(each).color), light(ground(each))];
        const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
        if (ratio < least.ratio) least = { ratio, text: each.textContent.slice(0, 60) };
    }
    return least;
}"""
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


def unfolded(opened: Any, key: str) -> Any:
    """Return a figure of the details, unfolded and in view."""
    opened.evaluate(
        "key => { const figure = document.querySelector(`[data-figure='${key}']`);"
        " figure.closest('details').open = true }",
        key,
    )
    figure = opened.locator(f'[data-figure="{key}"]')
    figure.scroll_into_view_if_needed()
    return figure


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
    figure = unfolded(opened, "signals 1")
    box = figure.bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
    opened.keyboard.down("Control")
    opened.mouse.wheel(0, -600)
    opened.keyboard.up("Control")
    opened.wait_for_function(f"before => ({VIEW})() != before", arg=before, timeout=30_000)


def test_the_values_of_all_are_told_at_the_pointer_and_a_click_hides_a_curve(opened: Any) -> None:
    figure = unfolded(opened, "signals 1")
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


def test_a_link_to_folded_details_unfolds_them(opened: Any) -> None:
    details = opened.locator("#log-2")
    opened.evaluate("() => { document.querySelector('#log-2').open = false }")
    opened.locator('nav a[href="#log-2"]').click()
    opened.wait_for_function("() => document.querySelector('#log-2').open")
    assert details.locator("table").is_visible()


def test_nothing_is_wider_than_a_telephone(opened: Any) -> None:
    before = opened.viewport_size
    opened.evaluate("() => document.querySelectorAll('details').forEach(each => each.open = true)")
    opened.set_viewport_size({"width": 390, "height": 800})
    width = opened.evaluate("document.documentElement.scrollWidth")
    opened.set_viewport_size(before)
    assert width <= 390


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_texts_have_enough_contrast(opened: Any, scheme: Any) -> None:
    opened.emulate_media(color_scheme=scheme)
    least = opened.evaluate(LEAST_CONTRAST)
    opened.emulate_media(color_scheme="light")
    assert least["ratio"] >= 4.5, least


def test_it_prints_on_a4_within_the_width_of_the_paper(opened: Any) -> None:
    before = opened.viewport_size
    opened.emulate_media(media="print")
    opened.set_viewport_size({"width": 680, "height": 960})  # A4 without margins of 15 mm
    width = opened.evaluate("document.documentElement.scrollWidth")
    folded = opened.evaluate(
        "() => getComputedStyle(document.querySelector('main > details:not(.many)'),"
        " '::details-content').contentVisibility"
    )
    opened.emulate_media(media="screen")
    opened.set_viewport_size(before)
    assert width <= 680
    assert folded == "visible"
    assert opened.pdf(format="A4").startswith(b"%PDF")
