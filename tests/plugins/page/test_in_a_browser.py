"""The page in a real Chromium: what it shows, what it survives, what its buttons do."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest

from tests.plugins.page.conftest import LINE, NAME, Server, write_story
from tests.waiting import wait_for
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.database.connection import connect

pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
from playwright.sync_api import Page, expect
from playwright.sync_api import TimeoutError as TooLateError

pytestmark = pytest.mark.slow
PATIENCE_MS = 120_000
FIGURES = "[...document.querySelectorAll('.figure')].map(each => each.figure?.data)"
CURVE = f"name => ({FIGURES})[0]?.curves?.find(each => each.name === name)"
MODE = f"() => ({FIGURES})[0]?.lanes?.[0]?.held.map(each => each[0])"
VIEW = "() => document.getElementById('signal-figure').figure?.view.x"


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

    def column(self, curve: str, column: str) -> list[Any]:
        self.page.wait_for_function(CURVE, arg=curve)
        return self.page.evaluate(CURVE, curve)[column]

    def until(self, curve: str, from_s: float, to_s: float) -> None:
        """Wait until a curve is drawn from so early to so late."""
        times = f"([name, from, to]) => {{ const t = ({CURVE})(name)?.t; return t"
        reaches = f"{times} && t[0] <= from && t.at(-1) >= to }}"
        self.page.wait_for_function(reaches, arg=[curve, from_s, to_s])

    def view(self) -> tuple[float, float]:
        """The time that the figure was drawn of."""
        start, end = self.page.evaluate(VIEW)
        return start, end

    def point(self, share: float = 0.5, y: float = 60.0) -> None:
        """Move the pointer over the signals."""
        box = self.page.locator("#signal-figure .stage > svg:first-child").bounding_box()
        assert box is not None
        self.page.mouse.move(box["x"] + share * box["width"], box["y"] + y)

    def says(self, text: str) -> None:
        expect(self.page.get_by_text(text).first).to_be_visible(timeout=PATIENCE_MS)

    def choose(self, title: str, option: str) -> None:
        """Choose the option that begins so."""
        select = self.page.get_by_label(title, exact=True)
        found = select.locator("option", has_text=re.compile(f"^{re.escape(option)}"))
        expect(found).to_have_count(1, timeout=PATIENCE_MS)
        select.select_option(value=found.get_attribute("value"))  # its light may change meanwhile


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
    tab.until("pose.0", 1, 119)
    places = tab.column("pose.0", "high")
    assert max(places) == pytest.approx(12.8, abs=0.1)
    assert tab.page.evaluate(MODE) == ["cruise", "back_up", "avoid", "cruise"]
    tab.says("this is an earlier run; it ended by reset")
    assert {url.split("/")[2] for url in tab.asked} == {f"127.0.0.1:{told.port}"}
    assert tab.page.get_by_role("button", name="Pause").count() == 0
    assert tab.errors == []


def test_two_runs_lie_over_each_other_from_their_starts(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("over it", "run 2 ")
    tab.choose("time", "all")
    for run in (2, 1):
        tab.until(f"pose.0, run {run}", 1, 29)


def test_the_list_of_runs_draws_each_and_opens_the_one_that_is_clicked(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.page.get_by_role("button", name="All runs").click()
    tab.says("Curves: ")
    rows = tab.page.locator("#run-rows tr")
    expect(rows).to_have_count(3, timeout=PATIENCE_MS)
    expect(rows.locator("path")).to_have_count(3, timeout=PATIENCE_MS)
    rows.filter(has=tab.page.get_by_role("button", name="1", exact=True)).click()
    tab.says("this is an earlier run; it ended by reset")
    expect(tab.page.locator("#run-rows [aria-current]")).to_have_attribute("data-run", "1")
    tab.page.get_by_role("button", name="All runs").click()
    expect(rows.first).to_be_hidden()
    assert tab.errors == []


def test_rows_of_the_list_of_runs_stay_where_another_signal_is_chosen(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.page.get_by_role("button", name="All runs").click()
    expect(tab.page.locator("#run-rows tr")).to_have_count(3, timeout=PATIENCE_MS)
    drawn = tab.page.locator("#runs-signal").inner_text()
    other = "pose.1" if drawn != "pose.1" else "pose.0"
    tab.page.evaluate("document.querySelector('#run-rows tr').isOld = true")
    tab.page.evaluate("names => change({ signals: names })", [other])
    expect(tab.page.locator("#runs-signal")).to_have_text(other, timeout=PATIENCE_MS)
    assert tab.page.evaluate("document.querySelector('#run-rows tr').isOld")


def test_a_zoom_reads_what_it_shows_and_the_address_brings_the_view_back(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "all")
    tab.until("pose.0", 1, 119)
    apart = difference_s(tab.column("pose.0", "t"))

    def zoomed() -> bool:  # a figure that is drawn anew meanwhile hears no wheel
        tab.point()
        tab.page.keyboard.down("Control")
        for _ in range(6):
            tab.page.mouse.wheel(0, -300)
        tab.page.keyboard.up("Control")
        near = f"() => {{ const x = ({VIEW})(); return x && x[1] - x[0] < 60 }}"
        with suppress(TooLateError):
            return bool(tab.page.wait_for_function(near, timeout=10_000))
        return False

    wait_for(zoomed)
    wait_for(lambda: difference_s(tab.column("pose.0", "t")) < apart / 2)
    wait_for(lambda: tab.view() == pytest.approx(tab.page.evaluate("wanted.view"), abs=0.01))
    before = tab.view()
    tab.page.reload()
    tab.page.wait_for_function(VIEW)
    assert tab.view() == pytest.approx(before, abs=0.001)  # the address has milliseconds


def difference_s(times: list[float]) -> float:
    return times[1] - times[0]


def test_a_signal_is_found_by_typing_and_moved_to_another_panel(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.column("pose.0", "t")
    tab.page.get_by_label("find a signal").fill("BATT")
    tab.page.get_by_label("battery_v").check()
    tab.column("battery_v", "t")
    panels = f"() => ({FIGURES})[0].panels"
    assert ["battery_v"] in tab.page.evaluate(panels)
    tab.page.locator('[data-hides="curve battery_v"]').hover()
    tab.page.mouse.down()
    tab.point(y=60)
    tab.page.mouse.up()
    tab.page.wait_for_function(f"() => ({panels})()[0].includes('battery_v')")
    assert tab.page.locator("body").inner_text().count("battery_v") > 0


def test_signals_are_a_tree_with_values_and_units_and_a_slash_begins_a_search(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.column("pose.0", "t")
    branch = tab.page.locator("#signals details", has_text="pose").first
    expect(branch.locator(".signal")).to_have_count(2, timeout=PATIENCE_MS)
    expect(branch.locator(".swatch path").first).to_be_attached(timeout=PATIENCE_MS)
    tab.page.keyboard.press("/")
    tab.page.keyboard.type("voltage")
    row = tab.page.locator(".signal")
    expect(row).to_have_count(1, timeout=PATIENCE_MS)
    expect(row).to_contain_text("battery_v")
    expect(row.locator(".value")).to_have_attribute("data-unit", "V", timeout=PATIENCE_MS)
    expect(row.locator(".value")).not_to_be_empty()
    row.drag_to(tab.page.locator("#signal-figure"), target_position={"x": 300, "y": 60})
    panels = f"() => ({FIGURES})[0].panels"
    tab.page.wait_for_function(f"() => ({panels})()[0].includes('battery_v')")
    assert tab.errors == []


def test_what_a_robot_does_not_have_takes_no_room(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "still")
    expect(tab.page.locator("#signals .signal")).to_have_count(1, timeout=PATIENCE_MS)
    expect(tab.page.locator("#right")).to_be_hidden(timeout=PATIENCE_MS)
    expect(tab.page.locator("#log")).to_be_hidden()


def test_the_values_of_all_are_told_at_the_pointer_and_in_a_replay(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "all")
    tab.until("pose.0", 1, 119)
    tab.point()
    shown = tab.page.locator("#signal-figure .told")
    for name in ("pose.0 ", "pose.1 ", "mode "):
        expect(shown).to_contain_text(name, timeout=PATIENCE_MS)
    tab.page.get_by_label("replay at").fill("20")
    expect(shown).to_contain_text("20.000 s", timeout=PATIENCE_MS)
    expect(tab.page.locator("#way-figure .overlay .heading")).to_have_count(1)
    assert "at=20" in tab.page.url


def test_a_click_on_a_log_line_or_an_event_and_the_keys_move_the_cursor_everywhere(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "all")
    tab.until("pose.0", 1, 119)
    line = tab.page.locator("#log p[data-time]").first
    line.click()
    at = float(line.get_attribute("data-time") or "nan")
    assert cursor(tab) == [at, at]
    expect(tab.page.locator("#log .at-cursor")).to_have_count(1)
    tab.page.keyboard.press("Escape")
    assert cursor(tab) == [None, None]
    figure = "document.getElementById('signal-figure').figure"
    event_s = tab.page.evaluate(f"{figure}.data.events[0].held[0][1]")
    share = tab.page.evaluate(
        f"({figure}.px({figure}.frames[0], {event_s}) + 3) / {figure}.svg.viewBox.baseVal.width"
    )
    tab.point(share)
    tab.page.mouse.down()
    tab.page.mouse.up()
    assert cursor(tab) == [event_s, event_s]
    tab.page.keyboard.press("ArrowRight")
    moved_s = cursor(tab)[0]
    assert moved_s is not None
    assert event_s < moved_s < event_s + 5
    tab.page.keyboard.press(" ")
    tab.page.wait_for_function(f"() => {figure}.at > {moved_s} + 0.1")
    tab.page.keyboard.press(" ")
    assert tab.errors == []


def test_the_controllers_variables_are_shown_near_the_cursor_and_as_text(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", NAME)
    shown = tab.page.locator("#variables")
    expect(shown).to_contain_text("Variables of the controller at 4.900 s (error: <script>")
    expect(shown.locator("details[open]")).to_have_count(1)
    expect(shown.locator("dt").first).to_have_text(NAME)
    expect(shown.locator("dd").first).to_have_text(LINE)
    tab.page.evaluate("showAt(1.0)")
    expect(shown).to_be_hidden()
    tab.page.evaluate("showAt(4.6)")
    expect(shown).to_be_visible()
    assert tab.page.evaluate("window.hacked") is None
    assert tab.errors == []


def cursor(tab: Tab) -> list[float | None]:
    """The times at which the two figures show their cursors."""
    places = "['signal-figure', 'way-figure']"
    return tab.page.evaluate(f"{places}.map(id => document.getElementById(id).figure.at)")


def test_a_view_whose_rows_are_loaded_needs_no_request(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "last 10 s")
    tab.until("pose.0", 111, 119)
    tab.page.wait_for_function("() => wanted.signals !== null")
    tab.page.wait_for_function("() => drawnScope && isLoaded(figures.signals.figure.view.x)")
    tab.page.wait_for_event("response", lambda answer: "/look?" in answer.url)
    asked = sum("/draw?" in url for url in tab.asked)
    tab.page.locator("#signal-figure .stage > svg:first-child").focus()
    for key in ("+", "+", "-"):
        tab.page.keyboard.press(key)
    for _ in range(5):
        tab.page.wait_for_event("response", lambda answer: "/look?" in answer.url)
    start_s, end_s = tab.view()
    assert end_s - start_s == pytest.approx(8, rel=0.1)
    assert sum("/draw?" in url for url in tab.asked) == asked


def test_all_robots_stand_on_one_map_and_a_narrow_window_holds_the_page(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.page.set_viewport_size({"width": 390, "height": 844})
    tab.choose("robot", "rover")
    tab.page.get_by_label("all robots").check()
    tracks = "() => document.getElementById('way-figure').figure?.data.tracks.map(t => t.name)"
    tab.page.wait_for_function(f"() => String(({tracks})()) === 'rover'")
    tab.says("still: no position was found")
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 390


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
    lanes = f"name => ({FIGURES})[0]?.lanes?.some(each => each.name === name)"
    tab.page.wait_for_function(lanes, arg=NAME)
    assert tab.page.evaluate("window.hacked") is None
    assert tab.errors == []


def test_it_moves_while_the_robot_moves_and_its_buttons_steer(
    opened: Callable[[Server], Tab], driven: Server
) -> None:
    tab = opened(driven)
    tab.says("running")
    # A chosen one: those shown unasked change as the robot goes on.
    tab.page.get_by_label("pose.y", exact=True).first.check()
    reached = tab.column("pose.y", "t")[-1]
    tab.until("pose.y", reached, reached + 1)
    tab.page.get_by_role("button", name="Pause").click()
    tab.says("pause: done")
    tab.says("paused")
    expect(tab.page.get_by_role("button", name="Pause", pressed=True)).to_be_enabled(
        timeout=PATIENCE_MS
    )
    stands = newest(driven, "SELECT max(sim_time_s) FROM state")
    tab.page.get_by_role("button", name="Step").click()
    tab.says("step: done")
    assert newest(driven, "SELECT max(sim_time_s) FROM state") > stands
    speed = tab.page.get_by_label("speed [rad/s] (0 to 10)")
    speed.fill("7")
    speed.press("Enter")
    tab.says("speed = 7: done")
    assert newest(driven, "SELECT value FROM parameter_value ORDER BY id DESC") == "7.0"
    speed.fill("70")  # and while it is typed, the loop stalls, and somebody else sets a value
    tab.page.evaluate("showParameters(shown.parameters, false)")
    assert speed.is_enabled()
    tab.page.evaluate("ask('steer', {robot: 'rover'}, {name: 'speed', value: 6})")
    for _ in range(3):
        tab.page.wait_for_event("response", lambda answer: "/look?" in answer.url)
    assert speed.input_value() == "70"
    speed.press("Enter")
    tab.says("a number from 0 up to 10, not 70")
    tab.page.get_by_role("button", name="Reset").click()
    tab.says("run 2, simulation time")
    tab.page.get_by_role("button", name="Step").click()  # it is still paused: no time passes
    tab.page.wait_for_function(f"() => ({FIGURES})[0]?.curves?.[0].t.at(-1) < {reached}")
    tab.page.get_by_role("button", name="Resume").click()
    tab.says("running")
    assert tab.errors == []


def test_buttons_are_off_with_the_reason_where_nobody_can_obey(
    opened: Callable[[Server], Tab], serve: Callable[..., Server], story: Path
) -> None:
    tab = opened(serve(story))
    tab.choose("robot", "rover")
    for name in ("Pause", "Resume", "Step", "Reset"):
        button = tab.page.get_by_role("button", name=name)
        expect(button).to_be_disabled(timeout=PATIENCE_MS)
        expect(button).to_have_attribute("title", re.compile("controller of rover is not running"))
    tab.page.evaluate("command('pause', {order: 'pause'})")
    refusal = tab.page.locator("#said details")
    expect(refusal).to_be_visible(timeout=PATIENCE_MS)
    short = refusal.locator("summary").inner_text()
    assert short.startswith("pause: ")
    assert len(short) < 140
    assert len(refusal.text_content() or "") > len(short)


def newest(server: Server, query: str) -> Any:
    with closing(connect(server.data_dir / DATABASE_NAME, "reader")) as connection:
        return connection.execute(query).fetchone()[0]


def test_it_survives_a_purge_a_database_that_goes_away_and_a_server_that_stops(
    opened: Callable[[Server], Tab], serve: Callable[..., Server], tmp_path: Path
) -> None:
    server = serve(tmp_path)
    tab = opened(server)
    tab.says("no controller with an MCPBridge has recorded there yet")
    expect(tab.page.get_by_role("button", name="Copy")).to_have_count(2)
    tab.says("bridge = MCPBridge.attach(robot)")
    expect(tab.page.locator("main")).to_be_hidden()
    write_story(tmp_path)
    tab.choose("robot", "rover")
    tab.column("pose.0", "mean")
    with closing(connect(tmp_path / DATABASE_NAME, "writer")) as connection:
        connection.execute("DELETE FROM state WHERE run_id = 3 AND sim_time_s < 30")
    tab.choose("time", "all")
    tab.column("pose.0", "mean")
    moved = shutil.move(tmp_path / DATABASE_NAME, tmp_path / "away.db")
    tab.says("no database at")
    shutil.move(moved, tmp_path / DATABASE_NAME)
    tab.says("run 3, simulation time")
    assert tab.errors == []
    said = server.stop()
    assert "Traceback" not in said, said
    tab.says("connection was lost")


def test_a_pan_shifts_painted_layers_and_lays_nothing_out(
    opened: Callable[[Server], Tab], told: Server
) -> None:
    tab = opened(told)
    tab.choose("robot", "rover")
    tab.choose("run", "run 1 ")
    tab.choose("time", "all")
    tab.until("pose.0", 1, 119)
    figure = "document.getElementById('signal-figure').figure"
    tab.page.evaluate(f"{figure}.held = {{}}")  # so that nothing is drawn anew meanwhile
    tab.page.evaluate(f"{figure}.show([20, 40])")
    changes = tab.page.evaluate(
        """figure => {
          const changed = [];
          const observer = new MutationObserver(found => changed.push(...found));
          observer.observe(figure.stage, {subtree: true, childList: true, attributes: true});
          for (let step = 1; step <= 20; step++) figure.pan(-step, 0);
          changed.push(...observer.takeRecords());
          observer.disconnect();
          const names = changed.map(each => `${each.target.localName} ${each.attributeName}`);
          return [...new Set(names)];
        }""",
        tab.page.evaluate_handle(figure),
    )
    assert changes == ["svg style"]
    low, high = tab.page.evaluate(f"{figure}.view.x")
    assert 20 < low < 40
    assert high - low == pytest.approx(20)
    painted = tab.page.evaluate(f"{figure}.painted.x")
    tab.page.evaluate(f"{figure}.pan(-3 * {figure}.frames[0].width, 0)")
    assert tab.page.evaluate(f"{figure}.painted.x") != painted


def test_the_map_shows_the_body_of_the_robot_and_where_it_heads(
    opened: Callable[[Server], Tab], driven: Server
) -> None:
    tab = opened(driven)
    figure = "document.getElementById('way-figure').figure"
    tab.page.wait_for_function(f"() => {figure}?.data.tracks[0].t.length > 1")
    track = tab.page.evaluate(f"{figure}.data.tracks[0]")
    lengths = [max(x for x, _ in part) - min(x for x, _ in part) for part in track["body"]]
    assert 0.02 < max(lengths) < 0.5  # of the rover, in metres
    assert all(-4 < heading < 4 for heading in track["heading"])
    body = tab.page.locator("#way-figure .body path").first
    expect(body).to_be_attached(timeout=PATIENCE_MS)
