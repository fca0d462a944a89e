"""The colours of the page have enough contrast in a light and in a dark browser (WCAG 2.2, AA)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from webots_mcp.plotting.colours import AREAS, LINES
from webots_mcp.plotting.interactive_svg import figure_part
from webots_mcp.plugins import page

CSS = (Path(page.__file__).parent / "parts" / "page.css").read_text("utf-8") + figure_part(
    "figure.css"
)
TEXT_CONTRAST = 4.5
"""Minimum for text, by success criterion 1.4.3."""
GRAPHIC_CONTRAST = 3.0
"""Minimum for curves and other parts of a figure, by success criterion 1.4.11."""
TEXT_PAIRS = [
    (text, ground)
    for text, grounds in {
        "ink": ("ground", "back", "pill", "good", "bad", "warn"),
        "faint": ("ground", "back"),
    }.items()
    for ground in grounds
]


def variables(scheme: str) -> dict[str, str]:
    light, dark = re.findall(r":root \{(.*?)\}", CSS, re.DOTALL)[:2]
    found = dict(re.findall(r"--(\w+): (#\w+)", light))
    return found | (dict(re.findall(r"--(\w+): (#\w+)", dark)) if scheme == "dark" else {})


def figure_rules(scheme: str) -> str:
    return CSS.split(f"@media screen and (prefers-color-scheme: {scheme})")[1].split("@media")[0]


def curves(scheme: str) -> list[str]:
    """The colours in which the page draws the curves."""
    replaced = dict(re.findall(r'\[stroke="(#\w+)"\] \{ stroke: (#\w+)', figure_rules(scheme)))
    return [replaced.get(line, line) for line in LINES]


def areas(scheme: str) -> list[str]:
    """The colours that the grounds of modes have where they lie on the ground of the page."""
    (opacity,) = re.findall(r"fill-opacity: ([\d.]+)", figure_rules(scheme))
    below = channels(variables(scheme)["ground"])
    mixed = [
        [float(opacity) * a + (1 - float(opacity)) * b
         for a, b in zip(channels(area), below, strict=True)]
        for area in AREAS
    ]  # fmt: skip
    return ["#" + bytes(map(round, each)).hex() for each in mixed]


def channels(colour: str) -> tuple[int, ...]:
    digits = colour[1:]
    digits = "".join(2 * each for each in digits) if len(digits) == 3 else digits[:6]
    return tuple(bytes.fromhex(digits))


def luminance(colour: str) -> float:
    shares = [each / 255 for each in channels(colour)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_black_on_white_has_the_contrast_that_the_standard_names() -> None:
    assert contrast("#000", "#ffffff") == pytest.approx(21)
    assert contrast("#767676", "#fff") == pytest.approx(4.54, abs=0.01)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(("text", "ground"), TEXT_PAIRS)
def test_text_can_be_read_on_its_ground(scheme: str, text: str, ground: str) -> None:
    colours = variables(scheme)
    assert contrast(colours[text], colours[ground]) >= TEXT_CONTRAST


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_curves_stand_out_from_the_ground_and_from_each_mode(scheme: str) -> None:
    grounds = [variables(scheme)["ground"], *areas(scheme)]
    weak = {
        (curve, ground): contrast(curve, ground)
        for curve in curves(scheme)
        for ground in grounds
        if contrast(curve, ground) < GRAPHIC_CONTRAST
    }
    assert weak == {}


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_ground_of_a_mode_outweighs_no_curve(scheme: str) -> None:
    ground = variables(scheme)["ground"]
    strongest_area = max(contrast(area, ground) for area in areas(scheme))
    weakest_curve = min(contrast(curve, ground) for curve in curves(scheme))
    assert strongest_area < weakest_curve / 2
