"""One tab: reads ten times a second what has come, and shows it.

What is long (a run of hours, its events) is gathered in a thread, and again when rows have come
and that did not take long; between, new rows are added to what is drawn.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from anyio import to_thread
from bokeh.document import Document, without_document_lock
from bokeh.layouts import column, row
from bokeh.models import DataRange1d, Div, GlyphRenderer

from webots_mcp.errors import (
    NoDatabaseError,
    NothingRecordedError,
    UnknownRobotError,
    WebotsMCPError,
)
from webots_mcp.parameter import Value
from webots_mcp.plugins.page.choice import Choice
from webots_mcp.plugins.page.chunk_maker import ChunkMaker
from webots_mcp.plugins.page.controls import (
    NEWEST,
    NONE,
    Parameters,
    Selectors,
    SignalTree,
    buttons,
)
from webots_mcp.plugins.page.growing import grow_signals, grow_way
from webots_mcp.plugins.page.markup import (
    log_markup,
    notes_markup,
    picture_markup,
    problem_markup,
    status_markup,
)
from webots_mcp.plugins.page.pacing import Beat
from webots_mcp.plugins.page.style import (
    CARD,
    LOG,
    NOTES,
    PICTURE,
    SCROLLING,
    STATUS,
    page_sheet,
    sheet,
)
from webots_mcp.plugins.page.tab_data import (
    Drawing,
    Look,
    RunKey,
    Surroundings,
    gather,
    look,
    look_around,
    rows_after,
)
from webots_mcp.plugins.report.charts import SignalsChart, WayChart, draw_signals, draw_way
from webots_mcp.store.recording import Recording
from webots_mcp.webots.orders import Order

if TYPE_CHECKING:
    from webots_mcp.plugins.page.steering_buttons import Told

_log: Final = logging.getLogger(__name__)
_PERIOD_MS: Final = 100
_AROUND_S: Final = 1.0  # between two looks at what changes seldom
_STATUS_S: Final = 0.5  # between two ages
_REDRAW_S: Final = 3.0  # between two drawings, at least;
_SETTLED_S: Final = 5.0  # of simulation time tell which signals change
_SHARE: Final = 0.1  # and so that drawing takes no more of the time
_HEIGHT_PX: Final = 800  # of a usual window;
_FIGURES_PX: Final = _HEIGHT_PX - 280  # of it for the signals
_EMPTY: Final = "Nothing to draw yet: the figures appear with the first rows of a run."


def open_tab(
    recording: Recording, read_only: bool, chunk_maker: ChunkMaker, document: Document
) -> None:
    """Make a document show a recording."""
    document.title = "webots-mcp"
    tab = Tab(recording, document, read_only=read_only, chunk_maker=chunk_maker)
    document.add_root(tab.layout)
    go_on: Any = tab.go_on
    document.add_periodic_callback(go_on, _PERIOD_MS)


class Tab:
    """What one tab shows, and what it has read.

    Args:
        recording: What is shown.
        document: Where it is shown.
        read_only: Without buttons, and without inputs for parameters.
        chunk_maker: What makes chunks meanwhile, if anything does.
    """

    def __init__(
        self,
        recording: Recording,
        document: Document,
        *,
        read_only: bool,
        chunk_maker: ChunkMaker | None = None,
    ) -> None:
        self._recording = recording
        self._steered = replace(recording, read_only=False)
        self._document = document
        self._chunk_maker = chunk_maker or ChunkMaker(recording)
        self._rounds = 0  # of its, when the figures were drawn
        self._read_only = read_only
        self._choice = Choice(window_s=60.0)
        self._shown: Look | None = None
        self._around: Surroundings | None = None
        self._drawing: Drawing | None = None
        self._drawn: tuple[RunKey, Choice] | None = None
        self._signals: SignalsChart | None = None
        self._way: WayChart | None = None
        self._until_s = 0.0  # simulation time up to which rows are drawn
        self._has_grown = False
        # Of the monotonic clock.
        self._next_around_s = self._next_drawing_s = self._next_status_s = 0.0
        self._said_status = ""
        self._beat = Beat()
        self._selectors = Selectors(self._chosen)
        self._tree = SignalTree(self._signals_chosen)
        self._parameters = Parameters(None if read_only else self._tune)
        self._make_places()
        self.layout = self._laid_out()

    async def go_on(self) -> None:
        """Look, and show what has changed; not while the browser is still at what came before."""
        if not self._beat.is_due:
            return
        self._document.hold("combine")  # the browser is sent what changed in one message
        try:
            self._shown = await to_thread.run_sync(look, self._recording, self._choice)
            self._say_status(self._shown)
            await self._look_around()
            await self._draw()
        except WebotsMCPError as error:
            self._say_problem(error)
        except Exception as error:  # noqa: BLE001  (the page would stand still without a word)
            if _say(self._said, problem_markup(error)):  # once, not at each look
                _log.exception("a tab cannot show all")
        finally:
            self._beat.send()
            self._document.unhold()

    def _say_status(self, shown: Look) -> None:
        """At once where it is another one; how old it is needs no more than to be readable."""
        now_s = time.monotonic()
        if shown.header["status"] != self._said_status or now_s >= self._next_status_s:
            self._said_status, self._next_status_s = shown.header["status"], now_s + _STATUS_S
            _say(self._status, status_markup(shown))

    async def _look_around(self) -> None:
        shown, now_s = self._shown, time.monotonic()
        if shown is None or now_s < self._next_around_s:
            return
        self._next_around_s = now_s + _AROUND_S
        around = await to_thread.run_sync(look_around, self._recording, shown)
        before, self._around = self._around, around
        self._selectors.offer(shown, around)
        self._tree.offer(around.names)
        settable = shown.is_newest and not self._read_only
        self._parameters.show(around.parameters, settable=settable)
        _say(self._log, log_markup(around.lines))
        if before is None or before.picture != around.picture:
            show = partial(picture_markup, around.picture, self._recording.data_dir)
            _say(self._picture, await to_thread.run_sync(show))

    async def _draw(self) -> None:
        """Draw anew where something else is to be shown, else add what has come."""
        shown = self._shown
        if shown is None or shown.key is None:
            return
        wanted = (shown.key, self._choice)
        self._look_at_cut()
        if wanted != self._drawn or (self._has_grown and time.monotonic() >= self._next_drawing_s):
            self._rounds = self._chunk_maker.rounds
            drawing = await to_thread.run_sync(gather, self._recording, shown, self._choice)
            is_other, self._drawn = wanted != self._drawn, wanted
            self._show(drawing, is_other=is_other)
        elif self._choice.beside_id is None:
            await self._grow(shown)
        else:  # runs over each other have clocks of their own
            self._has_grown = (shown.header["sim_time_s"] or 0.0) > self._until_s

    def _look_at_cut(self) -> None:
        """What could not be read in time is read again, at once where chunks were made since."""
        drawing = self._drawing
        if drawing is None or not drawing.is_cut:
            return
        self._has_grown = True
        if self._rounds != self._chunk_maker.rounds:
            self._next_drawing_s = 0.0
        said = [self._chunk_maker.says] if self._chunk_maker.says else []
        _say(self._notes, notes_markup([*said, *drawing.notes]))

    def _show(self, drawing: Drawing, *, is_other: bool) -> None:
        self._drawing, self._has_grown = drawing, False
        rest_s = max(_REDRAW_S, drawing.took_s / _SHARE)
        self._next_drawing_s = time.monotonic() + rest_s
        self._until_s = (self._shown and self._shown.header["sim_time_s"]) or 0.0
        if drawing.signals and not self._choice.beside_id:
            self._until_s = drawing.signals.x_range[1]
        self._show_signals(drawing, is_other=is_other)
        self._show_way(drawing, is_other=is_other)
        self._tree.choose(drawing.names)
        self._keep_names(drawing)
        _say(self._notes, notes_markup(drawing.notes))

    def _keep_names(self, drawing: Drawing) -> None:
        """Those that changed most are others later, and a person would not know why."""
        plot = drawing.signals
        lasts = plot is not None and plot.x_range[1] - plot.x_range[0] > _SETTLED_S
        if self._choice.names is None and lasts and self._shown and self._shown.key:
            self._choice = replace(self._choice, names=drawing.names)
            self._drawn = (self._shown.key, self._choice)

    def _show_signals(self, drawing: Drawing, *, is_other: bool) -> None:
        plot = drawing.signals
        if plot is None:
            self._signals = None
            self._figures.children = [self._empty]
        elif is_other or self._signals is None or not self._signals.refresh(plot):
            before = None if is_other or self._signals is None else self._signals.x_range
            self._signals = draw_signals(
                plot, x_range=before or self._time_range(), height_px=_FIGURES_PX - 40
            )
            _only_curves(self._signals)
            self._figures.children = [self._signals.layout]

    def _time_range(self) -> DataRange1d:
        if self._choice.window_s is None:
            return DataRange1d(range_padding=0, name="time")
        return DataRange1d(
            follow="end", follow_interval=self._choice.window_s, range_padding=0, name="time"
        )

    def _show_way(self, drawing: Drawing, *, is_other: bool) -> None:
        plot = drawing.way
        if plot is None:
            self._way = None
            self._ways.children = []
        elif is_other or self._way is None or not self._way.refresh(plot):
            self._way = draw_way(plot, obstacles=drawing.obstacles, legend_columns=2)
            figure: Any = self._way.layout
            figure.height = 330
            self._ways.children = [figure]

    async def _grow(self, shown: Look) -> None:
        """Add the rows that have come since to the figures."""
        drawing, key = self._drawing, shown.key
        if drawing is None or key is None:
            return
        if drawing.is_cut:  # what is new would stand behind what was not read
            return
        read = partial(rows_after, self._recording, key.run_id, drawing.read, self._until_s)
        columns = await to_thread.run_sync(read)
        if not columns.times:
            return
        self._until_s, self._has_grown = columns.times[-1], True
        if self._signals is not None:
            angles = {each.name for each in drawing.read if each.kind == "angle"}
            grow_signals(self._signals, columns, angles)
        if self._way is not None and drawing.position is not None:
            grow_way(self._way, drawing.position, columns)

    def _chosen(self) -> None:
        robot, run, beside, window = (str(each.value) for each in self._selectors.all)
        if robot != self._choice.robot and self._choice.robot is not None:
            run, beside = NEWEST, NONE
            self._selectors.run.value, self._selectors.beside.value = run, beside
            self._choice = replace(self._choice, names=None)
        self._choice = replace(
            self._choice,
            robot=robot or None,
            run_id=None if run == NEWEST else int(run),
            beside_id=None if beside == NONE else int(beside),
            window_s=float(window) if window else None,
        )
        self._next_around_s = 0.0

    def _signals_chosen(self, names: tuple[str, ...]) -> None:
        self._choice = replace(self._choice, names=names or None)

    def _steer(self, order: Order) -> None:
        from webots_mcp.plugins.page.steering_buttons import steer

        if self._shown is not None:
            self._command(order, partial(steer, self._steered, self._shown.robot, order))

    def _tune(self, name: str, value: Value) -> None:
        from webots_mcp.plugins.page.steering_buttons import tune

        if self._shown is not None:
            self._command(name, partial(tune, self._steered, self._shown.robot, name, value))

    def _command(self, what: str, ask: Callable[[], Any]) -> None:
        """Ask for it while the page goes on, and say what came of it."""
        _say(self._said, notes_markup([f"{what}: …"]))

        @without_document_lock
        async def wait() -> None:
            told = await ask()
            self._document.add_next_tick_callback(partial(self._answered, told))

        asking: Any = wait
        self._document.add_next_tick_callback(asking)

    def _answered(self, told: Told) -> None:
        _say(self._said, notes_markup([told.text]))
        if not told.is_done:  # what is done shows with the next look; meanwhile somebody may type
            self._parameters.put_back()
        self._next_around_s = 0.0

    def _say_problem(self, error: WebotsMCPError) -> None:
        """What is drawn stays: a database may be away for a moment only."""
        _say(self._status, problem_markup(error))
        self._next_status_s = 0.0
        if isinstance(error, (NoDatabaseError, NothingRecordedError, UnknownRobotError)):
            self._drawn = None
            self._selectors.run.value, self._selectors.beside.value = NEWEST, NONE
        if isinstance(error, UnknownRobotError):  # another database has taken the place
            self._choice = replace(self._choice, robot=None)

    def _make_places(self) -> None:
        self._status = Div(name="status", stylesheets=sheet(STATUS), sizing_mode="stretch_width")
        self._said = Div(name="said", stylesheets=sheet(NOTES), sizing_mode="stretch_width")
        self._notes = Div(name="notes", stylesheets=sheet(NOTES), sizing_mode="stretch_width")
        self._log = Div(name="log", stylesheets=sheet(LOG), sizing_mode="stretch_width")
        self._picture = Div(name="picture", stylesheets=sheet(PICTURE), width=320)
        self._empty = Div(text=_EMPTY, name="empty", stylesheets=sheet(NOTES))
        self._figures: Any = column(self._empty, sizing_mode="stretch_width", name="figures")
        self._ways: Any = column(name="way", width=330)

    def _laid_out(self) -> Any:
        title = Div(text="<h1>webots-mcp</h1>", stylesheets=sheet(STATUS), align="center")
        orders: list[Any] = []
        if not self._read_only:
            from webots_mcp.plugins.page.steering_buttons import ORDERS

            orders = [buttons(ORDERS, self._steer)]
        head = row(title, *self._selectors.all, *orders, sizing_mode="stretch_width")
        state = row(self._status, self._said, sizing_mode="stretch_width")
        side = column(
            self._tree.layout, self._parameters.layout, width=200, height=_HEIGHT_PX - 130,
            stylesheets=sheet(CARD, SCROLLING),
        )  # fmt: skip
        drawn = column(
            self._figures, self._notes, sizing_mode="stretch_width", height=_FIGURES_PX,
            stylesheets=sheet(CARD, SCROLLING),
        )  # fmt: skip
        log = column(self._log, sizing_mode="stretch_width", stylesheets=sheet(CARD, SCROLLING))
        right = column(self._ways, self._picture, width=350, stylesheets=sheet(CARD, SCROLLING))
        middle = column(drawn, log, sizing_mode="stretch_width", spacing=10)
        body = row(side, middle, right, sizing_mode="stretch_width", spacing=10)
        return column(
            head, state, body, sizing_mode="stretch_width", spacing=6, margin=10,
            stylesheets=page_sheet(), tags=self._beat.models,
        )  # fmt: skip


def _say(place: Div, markup: str) -> bool:
    """Only what has changed goes to the browser; returns whether it has."""
    has_changed = place.text != markup
    if has_changed:
        place.text = markup
    return has_changed


def _only_curves(chart: SignalsChart) -> None:
    """Time reaches as far as the curves do, not as far as what is marked beyond them."""
    curves = [source for (what, *_), source in chart.sources.items() if what == "curve"]
    drawn: list[Any] = [
        each
        for each in chart.layout.select({})
        if isinstance(each, GlyphRenderer) and each.data_source in curves
    ]
    if drawn and isinstance(chart.x_range, DataRange1d):
        chart.x_range.renderers = drawn
