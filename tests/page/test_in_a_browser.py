"""The page in a real Chromium: what it shows, what it survives, what its buttons do."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.page.conftest import LINE, NAME, Server, write_story
from webots_mcp.connection import connect
from webots_mcp.contract import DATABASE_NAME

pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
from playwright.sync_api import Page, expect

PATIENCE_MS = 120_000
# Models that are shown no more are forgotten a little later: the last one of a name is meant.
NAMED = "name => [...Bokeh.documents[0]._all_models.values()].filter(m => m.name == name).at(-1)"
SOURCE = f"""name => {{
  const source = ({NAMED})(name)
  return source ? [...source.get_array(%r)] : null
}}"""
RANGE = f"() => {{ const r = ({NAMED})('time'); return [r.start, r.end] }}"


class Tab:
    """A page that is open, and all that it asked for."""

    def __init__(self, page: Page, server: Server) -> None:
        self.page = page
        self.asked: list[str] = []
        self.errors: list[str] = []
        page.set_default_timeout(PATIENCE_MS)
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.goto(server.url)

    def column(self, source: str, column: str) -> list[Any]:
        self.page.wait_for_function(f"name => ({SOURCE % column})(name) !== null", arg=source)
        return self.page.evaluate(SOURCE % column, source)

    def until(self, source: str, column: str, least: float) -> None:
        """Wait until a column has a number that is at least so large."""
        has = f"([name, least]) => (({SOURCE % column})(name) ?? []).some(each => each >= least)"
        self.page.wait_for_function(has, arg=[source, least])

    def until_it_is(self, source: str, column: str, values: list[str]) -> None:
        same = f"([name, all]) => String(({SOURCE % column})(name)) == String(all)"
        self.page.wait_for_function(same, arg=[source, values])

    def time(self) -> tuple[float, float]:
        start, end = self.page.evaluate(RANGE)
        return start, end

    def says(self, text: str) -> None:
        expect(self.page.get_by_text(text).first).to_be_visible(timeout=PATIENCE_MS)

    def choose(self, title: str, option: str) -> None:
        """Choose the option that begins so."""
        select = self.page.get_by_label(title, exact=True)
        found = select.locator("option", has_text=re.compile(f"^{re.escape(option)}"))
        expect(found).to_have_count(1, timeout=PATIENCE_MS)
        select.select_option(label=found.inner_text())


@pytest.fixture
def opened(chromium: Any) -> Iterator[Callable[[Server], Tab]]:
    """Open the page of a server in a tab of its own."""
    contexts: list[Any] = []

    def start(server: Server) -> Tab:
        contexts.append(chromium.new_context(viewport={"width": 1280, "height": 800}))
        return Tab(contexts[-1].new_page(), server)

    yield start
    for context in contexts:
        context.close()


def test_it_shows_the_values_of_the_database_and_asks_nobody_else(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "all")
    tab.until("curve pose.0 1", "time_s", 119)
    places = tab.column("curve pose.0 1", "mean")
    assert max(place for place in places if place == place) == pytest.approx(12.8, abs=0.1)
    tab.until_it_is("ground mode 0", "value", ["cruise", "back_up", "avoid", "cruise"])
    tab.says("this is an earlier run; it ended by reset")
    assert {url.split("/")[2] for url in tab.asked} == {f"127.0.0.1:{told.port}"}
    assert tab.page.get_by_role("button", name="Pause").count() == 0
    assert tab.errors == []


def test_two_runs_lie_over_each_other_and_all_figures_zoom_together(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("over it", "run 2 ")
    tab.choose("time", "all")
    starts = [tab.column(f"curve pose.0 {run}", "time_s")[0] for run in (2, 1)]
    assert max(starts) < 1
    tab.page.wait_for_function(f"() => ({RANGE})()[1] > 100")
    before = tab.time()
    plot = tab.page.locator(".bk-Figure").first.bounding_box()
    assert plot is not None
    tab.page.mouse.move(plot["x"] + plot["width"] / 2, plot["y"] + plot["height"] / 2)
    tab.page.keyboard.down("Control")
    tab.page.mouse.wheel(0, -300)
    tab.page.keyboard.up("Control")
    tab.page.wait_for_function(f"before => ({RANGE})()[1] < before - 5", arg=before[1])
    assert tab.time()[0] > before[0]


def test_of_a_run_without_rows_it_says_so_and_stays_with_it(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "still")
    tab.choose("run", "run 5 ")
    tab.says("run 5 of robot 'still' has no state row yet")
    tab.says("this is an earlier run; it ended by an unknown cause")
    assert tab.errors == []


def test_what_was_recorded_is_text_and_nothing_else(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", NAME)
    tab.says(LINE)
    tab.page.get_by_label(NAME, exact=True).check()
    tab.column(f"lane {NAME} 0", "value")
    assert tab.page.evaluate("window.hacked") is None
    assert tab.errors == []


def test_it_moves_while_the_robot_moves_and_its_buttons_steer(
    opened: Callable[[Server], Tab], driven: Server
) -> None:
    tab = opened(driven)
    tab.says("running")
    (source,) = tab.page.evaluate_handle(
        "() => [...Bokeh.documents[0]._all_models.values()]"
        ".map(each => each.name).filter(name => name && name.startsWith('curve pose.'))"
        ".slice(0, 1)"
    ).json_value() or ["curve pose.x 1"]
    reached = tab.column(source, "time_s")[-1]
    tab.until(source, "time_s", reached + 1)
    tab.page.get_by_role("button", name="Pause").click()
    tab.says("pause: done")
    tab.says("paused")
    stands = newest(driven, "SELECT max(sim_time_s) FROM state")
    tab.page.get_by_role("button", name="Step").click()
    tab.says("step: done")
    assert newest(driven, "SELECT max(sim_time_s) FROM state") > stands
    speed = tab.page.get_by_label("speed [rad/s] (0 to 10)")
    speed.fill("7")
    speed.press("Enter")
    tab.says("speed = 7: done")
    assert newest(driven, "SELECT value FROM parameter_value ORDER BY id DESC") == "7.0"
    speed.fill("70")
    speed.press("Enter")
    tab.says("a number from 0 up to 10, not 70")
    tab.page.get_by_role("button", name="Reset").click()
    tab.says("run 2, simulation time")
    tab.page.get_by_role("button", name="Resume").click()
    tab.says("running")
    tab.column(source.replace(" 1", " 2"), "time_s")  # the new run is followed
    assert tab.errors == []


def newest(server: Server, query: str) -> Any:
    with closing(connect(server.data_dir / DATABASE_NAME, "reader")) as connection:
        return connection.execute(query).fetchone()[0]


def test_it_survives_a_purge_a_database_that_goes_away_and_a_server_that_stops(
    opened: Callable[[Server], Tab], serve: Callable[..., Server], tmp_path: Path
) -> None:
    server = serve(tmp_path)
    tab = opened(server)
    tab.says("no controller with an MCPBridge has recorded there yet")
    write_story(tmp_path)
    tab.choose("robot", "rover")
    tab.column("curve pose.0 3", "mean")
    with closing(connect(tmp_path / DATABASE_NAME, "writer")) as connection:
        connection.execute("DELETE FROM state WHERE run_id = 3 AND sim_time_s < 30")
    tab.choose("time", "all")
    tab.column("curve pose.0 3", "mean")
    moved = shutil.move(tmp_path / DATABASE_NAME, tmp_path / "away.db")
    tab.says("no database at")
    shutil.move(moved, tmp_path / DATABASE_NAME)
    tab.says("run 3, simulation time")
    assert tab.errors == []
    assert "Traceback" not in server.stop()
    tab.says("connection was lost")
