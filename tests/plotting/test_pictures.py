"""What a picture shows, and that everything in it can be read."""

from __future__ import annotations

import io
import math
import re
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import pytest
from PIL import Image, ImageFont
from pydantic import TypeAdapter

from tests.plotting.conftest import Record, whole
from webots_mcp.errors import (
    InvalidInputError,
    InvalidRangeError,
    NothingRecordedError,
    UnknownRunError,
    UnknownSignalError,
)
from webots_mcp.plotting import PlotKind, plot
from webots_mcp.plotting.canvas import Canvas, PlotImage, Sheet, image_format_of
from webots_mcp.plotting.colours import LINES
from webots_mcp.plotting.curves import Curve, Panel
from webots_mcp.plotting.intervals import Interval
from webots_mcp.plotting.line_styles import DASHES
from webots_mcp.plotting.signal_plot import compose_signals, paint_signals, plot_signals
from webots_mcp.plotting.trajectory import compose_trajectory, paint_trajectory
from webots_mcp.questions.arguments import RunIds
from webots_mcp.store.chunk_making import make_chunks
from webots_mcp.store.reading.ranges import Scope, find_range

Ask = dict[str, Any]
QUESTIONS: dict[str, Ask] = {
    "one signal": {"signals": ["sensors.front"]},
    "several scales": {"signals": ["pose", "heading", "target", "battery_v", "sensors"]},
    "everything": {"signals": ["*"]},
    "text alone": {"signals": ["mode", "sensors.bumper"]},
    "a part": {"signals": ["pose.0", "ir"], "start_s": 38, "end_s": 66},
    "what changed most": {},
    "two runs": {"signals": ["pose.0", "battery_v"], "run_ids": [1, 3]},
    "trajectory": {"kind": "trajectory"},
    "trajectory by time": {"kind": "trajectory", "bands": ""},
    "two trajectories": {"kind": "trajectory", "run_ids": [1, 3]},
}


def ask(connection: sqlite3.Connection, **question: Any) -> PlotImage:
    question.setdefault("run_ids", [1])
    asked = {each.name: question.pop(each.name, None) for each in fields(Scope)}
    return plot(connection, **question, scope=Scope(**asked))


def words(picture: PlotImage) -> set[str]:
    """The texts in an SVG."""
    root = ElementTree.fromstring(picture.data)
    texts = root.iter("{http://www.w3.org/2000/svg}text")
    return {"".join(text.itertext()).strip() for text in texts}


@pytest.mark.parametrize("question", QUESTIONS.values(), ids=QUESTIONS)
def test_every_kind_of_picture_is_a_png_of_the_size_that_was_asked_for_and_the_same_svg_each_time(
    rover: sqlite3.Connection, question: Ask
) -> None:
    one, other = (ask(rover, **question, image_format="svg") for _ in range(2))
    assert (one.media_type, one.data) == ("image/svg+xml", other.data)
    assert len(words(one)) > 5
    picture = ask(rover, **question)
    assert picture.media_type == "image/png"
    image = Image.open(io.BytesIO(picture.data))
    image.load()
    rows_alone = "mode" in question.get("signals", ())
    assert image.size == (900, 480 if rows_alone else 500)
    assert len(picture.data) < 250_000
    assert picture.caption.startswith("rover")


def test_a_picture_names_what_it_shows(rover: sqlite3.Connection) -> None:
    picture = ask(rover, signals=["pose.0", "heading"], image_format="svg")
    assert words(picture) >= {
        "rover, run 1, 0 to 119.9 s", "pose.0", "heading [rad]", "mode:", "cruise", "back_up",
        "avoid", "nothing recorded", "stuck (1)", "oscillation (1)", "log (2)", "error",
        "command (1)", "set_speed", "12.8", "3.14",
    }  # fmt: skip
    steps = "simulation time [s]; line: mean by time, band: minimum to maximum of every 0.6 s"
    assert " ".join(steps.split()) in {" ".join(word.split()) for word in words(picture)}
    assert picture.caption == (
        "rover, run 1, 0 to 119.9 s. Curves with their last values: pose.0 12.8; heading 3.14 rad. "
        "Background: mode. Events: stuck (1), jump (1), oscillation (1), log (2), command (1)"
    )


def test_a_legend_names_what_differs_below_what_the_names_share(record: Record) -> None:
    def wheels(time_s: float) -> dict[str, Any]:
        return {"robot": {"wheels": {"left": {"rad_s": time_s}, "right": {"rad_s": 2 * time_s}}}}

    connection = record(wheels)
    picture = ask(connection, signals=["robot.*"], image_format="svg")
    assert words(picture) >= {"robot.wheels.*.rad_s [rad/s]", "left", "right", "9.9", "19.8"}
    assert not [word for word in words(picture) if word.startswith("robot.wheels.left")]
    assert "robot.wheels.left.rad_s 9.9 rad/s, robot.wheels.right.rad_s 19.8" in picture.caption


@pytest.mark.parametrize(
    ("names", "shared", "own"),
    [
        (["a.x", "a.y"], "a.*", ["x", "y"]),
        (["left.v", "right.v"], "*.v", ["left", "right"]),
        (["a.b.c.v", "a.d.v"], "a.*.v", ["b.c", "d"]),
        (["a", "a.a"], "", ["a", "a.a"]),
        (["x.a.a", "x.a"], "x.*", ["a.a", "a"]),
        (["front_left", "front_right"], "", ["front_left", "front_right"]),
        (["a.x"], "", ["a.x"]),
    ],
    ids=str,
)
def test_what_names_share_is_whole_parts_and_leaves_something_of_each(
    names: list[str], shared: str, own: list[str]
) -> None:
    panel = Panel([Curve(name, None, 1, (), 0.0, 1.0) for name in names])
    assert (panel.shared_name, list(panel.own_names.values())) == (shared, own)


def test_values_at_the_ends_of_curves_do_not_cover_each_other(record: Record) -> None:
    connection = record(lambda t: {f"arm.{n}": 1 + n / 100 + t / 50 for n in range(5)})
    axes, _ = compose_signals(connection, [whole(connection)], ["arm.*"])
    texts = texts_of(paint_signals(axes, 900, 500)[0])
    assert_readable(texts, (900, 500))
    assert {"1.198", "1.208", "1.218", "1.228", "1.238"} <= {text for text, _ in texts}


def test_kinds_that_no_signal_shows_are_one_short_note(rover: sqlite3.Connection) -> None:
    notes = [note for note in ask(rover, signals=["pose.0"]).notes if "searched" in note]
    assert notes == [
        "Not searched for off_target, fall, slip: what would show them is not recorded"
    ]


def test_what_could_not_be_drawn_is_said(rover: sqlite3.Connection) -> None:
    picture = ask(rover, signals=["*"])
    (left_out,) = [note for note in picture.notes if note.startswith("Left out")]
    assert "battery_v" in left_out and "3 panels and 4 rows" in left_out
    assert "Not drawn of sensors.front in run 1: 40 values nan" in picture.notes
    blind = ask(rover, signals=["sensors.front", "ir"], start_s=100.5, end_s=103)
    assert "No value in run 1: sensors.front" in blind.notes


def test_numbers_too_large_to_draw_are_not_said_to_be_missing(record: Record) -> None:
    connection = record(lambda time_s: {"big": 1e301, "x": time_s})
    assert "Too large to draw (beyond 1e100) in run 1: big" in ask(connection, signals=["*"]).notes


def test_runs_are_laid_over_each_other_from_their_starts_and_named_by_their_labels(
    record: Record,
) -> None:
    connection = record(lambda t: {"mode": "go", "x_m": t})
    connection.execute("UPDATE run SET label = 'softer turns' WHERE id = 1")
    connection.execute(
        "INSERT INTO run (session_id, robot_id, start_reason, started_wall_time_s, "
        "started_sim_time_s, last_wall_time_s, last_sim_time_s) VALUES (1, 1, 'reload', 0, 0, 0, 0)"
    )
    connection.executemany(
        "INSERT INTO state (run_id, sim_time_s, wall_time_s, data) VALUES (2, ?, 0, ?)",
        [(500 + n / 10, f'{{"mode": "go", "x_m": {n / 5}}}') for n in range(100)],
    )
    ranges = [whole(connection, 1), whole(connection, 2)]
    axes, _ = compose_signals(connection, ranges, ["x_m"])
    assert axes.x_range == pytest.approx((0, 9.9))
    assert [curve.points[0][:2] for curve in axes.panels[0].curves] == [(0, 0), (0, 0)]
    assert axes.bands is None
    assert [lane.name for lane in axes.lanes] == ["mode, run 1 “softer turns”", "mode, run 2"]
    picture = plot(connection, "signals", ["x_m"], run_ids=[1, 2], image_format="svg")
    assert words(picture) >= {"run 1 “softer turns”", "run 2", "x_m [m]"}


def test_a_flag_and_a_text_below_the_curves_are_labelled_or_in_the_legend(
    rover: sqlite3.Connection,
) -> None:
    picture = ask(rover, signals=["mode", "sensors.bumper"], image_format="svg")
    assert words(picture) >= {"mode", "sensors.bumper", "cruise", "avoid", "back_up", "true"}


def test_the_other_run_of_a_trajectory_is_told_apart_and_trouble_is_marked(
    rover: sqlite3.Connection,
) -> None:
    picture = ask(rover, kind="trajectory", run_ids=[1, 3], image_format="svg")
    assert words(picture) >= {
        "run 1", "run 3", "start", "end", "pose.0 [m]", "pose.1 [m]", "stuck over 3 s (1), run 1",
        "sensors.bumper (1), run 1",
    }  # fmt: skip
    assert "Start of run 3 (0, 0), end (18.0, 0). Marks: stuck over 3 s (1) of run 1" in (
        picture.caption
    )


# Everything can be read ---------------------------------------------------------------------------


def odd_names(time_s: float) -> dict[str, Any]:
    """Names and values that a careless controller may publish."""
    return {
        "mode": f"a_rather_long_name_of_a_mode_number_{int(time_s) % 12}",
        "_hidden": math.sin(time_s),
        "costs in $ per $ spent": math.cos(time_s),
        "a.very.deeply.nested.name.of.a.signal.that.goes.on.and.on_m_s": time_s,
        "two   words": 3 * math.sin(time_s),
        "距離_m": 2 + math.sin(time_s / 2),
        "flag": int(time_s) % 2 == 0,
        "huge": 1e9 * time_s,
        "tiny": 1e-9 * time_s,
        "pose": {"x": math.cos(time_s), "y": math.sin(time_s)},
    }


class Box(NamedTuple):
    """Where a text is, in pixels."""

    x0: float
    y0: float
    x1: float
    y1: float


_TURNED = re.compile(r"translate\(([-\d.]+)[ ,]([-\d.]+)\)( rotate\(-90\))?")
_FONT = ImageFont.load_default(100)
_WIDER = 1.2  # than Pillow's font DejaVu Sans is, which is wide


def texts_of(canvas: Canvas) -> list[tuple[str, Box]]:
    """Every text with its box in pixels."""
    return list(_boxes(ElementTree.fromstring(canvas.svg()), 0.0, 0.0))


def _boxes(element: Any, dx: float, dy: float) -> Iterator[tuple[str, Box]]:
    moved = _TURNED.match(element.get("transform", ""))
    if moved:
        dx, dy = dx + float(moved[1]), dy + float(moved[2])
    if element.tag.endswith("text") and (element.text or "").strip():
        size = float(element.get("font-size"))
        length = _FONT.getlength(element.text) * size / 100 * _WIDER
        share = {"middle": 0.5, "end": 1.0}.get(element.get("text-anchor"), 0.0)
        x, y = dx + float(element.get("x")), dy + float(element.get("y"))
        if moved and moved[3]:  # upwards
            yield element.text, Box(x - 0.8 * size, y - length * share, x, y + length * share)
        else:
            start = x - length * share
            yield element.text, Box(start, y - 0.75 * size, start + length, y + 0.15 * size)
    for child in element:
        yield from _boxes(child, dx, dy)


@pytest.mark.parametrize("size", [(900, 500), (1400, 500), (600, 400), (400, 300)])
@pytest.mark.parametrize(
    "names", [["*"], ["mode", "flag"], ["_hidden", "two*"], ["a.very.*"]], ids=str
)
def test_no_text_leaves_the_picture_or_covers_another(
    record: Record, names: list[str], size: tuple[int, int]
) -> None:
    connection = record(odd_names, 300)
    sheet = Sheet(*size)
    axes, _ = compose_signals(connection, [whole(connection)], names, room=sheet.room)
    assert_readable(texts_of(paint_signals(axes, *size)[0]), size)


@pytest.mark.parametrize("size", [(900, 500), (400, 300), (400, 1200)])
def test_no_text_of_a_trajectory_leaves_the_picture_or_covers_another(
    record: Record, size: tuple[int, int]
) -> None:
    connection = record(odd_names, 300)
    axes, _ = compose_trajectory(connection, [whole(connection)])
    assert_readable(texts_of(paint_trajectory(axes, *size)[0]), size)


def test_a_name_that_no_font_has_is_a_note_and_stays_text_in_an_svg(record: Record) -> None:
    no_script = "\U0010fffd"  # for private use: no font has it
    connection = record(lambda t: {"mode": no_script, "x_m": t})
    (note,) = [n for n in plot(connection, signals=["x_m"]).notes if "font" in n]
    assert repr(no_script) in note
    picture = plot(connection, signals=["x_m"], image_format="svg")
    assert not [note for note in picture.notes if "font" in note]
    assert no_script in words(picture)


def test_letters_of_other_scripts_are_drawn_where_a_font_has_them(record: Record) -> None:
    """Liberation Sans, DejaVu Sans and the fonts of every desktop have Greek and Cyrillic."""
    connection = record(lambda t: {"скорость": t, "γωνία": 2 * t})
    notes = plot(connection, signals=["*"]).notes
    assert all("скорость" not in note for note in notes if "font" in note)


def test_a_constant_but_for_rounding_is_a_flat_line(record: Record) -> None:
    low, high = 5.999999999999998, 6.000000000000005
    connection = record(lambda t: {"n": low if round(t * 10) % 2 else high})
    picture = plot(connection, signals=["n"], image_format="svg")
    labels = [float(each) for each in words(picture) if re.fullmatch(r"\d\.\d+", each)]
    assert 6.0 in labels
    assert max(labels) - min(labels) > 0.1


def test_a_title_that_is_too_long_keeps_its_end(record: Record) -> None:
    connection = record(lambda t: {"n": t})
    connection.execute("UPDATE robot SET name = ?", ("rover_" * 100,))
    picture = plot(connection, signals=["n"], width_px=400, image_format="svg")
    assert any(word.endswith("run 1, 0 to 9.9 s") for word in words(picture))


def assert_readable(texts: list[tuple[str, Any]], size: tuple[int, int]) -> None:
    assert len(texts) > 5
    for text, box in texts:
        assert box.x0 >= 0 and box.y0 >= 0, f"{text!r} is cut off: {box}"
        assert box.x1 <= size[0] and box.y1 <= size[1], f"{text!r} is cut off: {box}"
    for (text, box), (other, beside) in combinations(texts, 2):
        wide = min(box.x1, beside.x1) - max(box.x0, beside.x0)
        high = min(box.y1, beside.y1) - max(box.y0, beside.y0)
        assert wide < 2 or high < 2, f"{text!r} and {other!r} overlap by {wide:.0f} x {high:.0f} px"


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", ["webots_mcp.server.mcp_server", "webots_mcp.plotting", "webots_mcp"]
)
def test_what_draws_waits_for_the_first_picture(module: str) -> None:
    code = (
        f"import sys, {module}\n"
        "from webots_mcp import MCPBridge\n"
        "print({'resvg_py', 'numpy', 'PIL'} & set(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "set()"


# Long and short recordings ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_recording_too_long_to_be_read_is_drawn_from_its_chunks(record: Record) -> None:
    connection = record(lambda t: {"v": 3.0 if t == 160 else 12.0, "x": t, "y": 0.0}, 31_000)
    assert make_chunks(connection, 100_000).done
    axes, _ = compose_signals(connection, [whole(connection)], ["v", "x"])
    (curve,) = [c for panel in axes.panels for c in panel.curves if c.name == "v"]
    assert min(point[2] for point in curve.points) == curve.low == 3.0
    picture = plot(connection, "trajectory")
    assert picture.notes == ("run 1: one position every 0.2 s (too many rows to draw each)",)


@pytest.mark.parametrize("rows", [1, 2])
def test_a_run_that_has_only_begun_is_drawn(record: Record, rows: int) -> None:
    connection = record(lambda t: {"pose": [0.0, 0.0], "mode": "idle"}, rows)
    for kind in ("signals", "trajectory"):
        assert plot(connection, kind, image_format="svg").data
    assert plot(connection, "trajectory", bands="").data


# Bad input ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("question", "error", "message"),
    [
        ({"signals": ["sensor.frnt"]}, UnknownSignalError, "15 signals: sensors.front"),
        ({"signals": ["pose"], "bands": "mod"}, UnknownSignalError, "mode"),
        ({"signals": ["pose"], "bands": "ir"}, InvalidInputError, "'ir' holds numbers"),
        ({"signals": ["pose"], "bands": "sensors"}, InvalidInputError, "matches 2 signals"),
        ({"run_ids": [77]}, UnknownRunError, "No run 77 is"),
        ({"start_s": 9, "end_s": 3}, InvalidRangeError, "reversed"),
        ({"start_s": 900}, NothingRecordedError, "begins after the newest row"),
        ({"signals": ["sensors.front"], "start_s": 101, "end_s": 103, "bands": ""},
         NothingRecordedError, "none of the signals has a value in rover, run 1, 101 to 103 s"),
        ({"width_px": 12}, InvalidInputError, "width_px=12 must be from 400 to 2000"),
        ({"image_format": "gif"}, InvalidInputError, "png or svg, not 'gif'"),
        ({"kind": "pie"}, InvalidInputError, "Kinds: signals, trajectory"),
        ({"kind": "trajectory", "signals": ["pose.0"]}, InvalidInputError, "takes two signals"),
        ({"kind": "trajectory", "signals": ["mode", "pose.0"]}, InvalidInputError, "no numbers"),
        ({"run_ids": [], "since_wall_time": 0, "robot": "rovr"}, InvalidInputError, "'rover'"),
    ],
)  # fmt: skip
def test_a_question_that_makes_no_sense_is_answered_with_what_there_is(
    rover: sqlite3.Connection, question: Ask, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        ask(rover, **question)


def test_a_robot_without_a_position_is_asked_for_one(record: Record) -> None:
    connection = record(lambda t: {"altitude": t})
    with pytest.raises(
        InvalidInputError, match=r"among the 1 signals\..*signals of numbers: altitude$"
    ):
        plot(connection, "trajectory")


def test_too_many_runs_in_one_picture_are_refused(record: Record) -> None:
    connection = record(lambda t: {"n": t}, 2)
    ranges = [whole(connection)] * 11
    with pytest.raises(InvalidInputError, match="holds 11 runs, and at most 10"):
        plot_signals(connection, ranges, ["n"])


@pytest.mark.parametrize("kind", ["signals", "trajectory"])
def test_as_many_runs_as_a_tool_may_be_given_are_drawn_and_told_apart(
    record: Record, kind: PlotKind
) -> None:
    (given, _) = TypeAdapter[Any](RunIds).json_schema()["anyOf"]
    run_ids = [*range(1, given["maxItems"] + 1)]
    connection = record(lambda t: {"pose": [t, math.sin(t)]}, *[20] * len(run_ids))
    picture = plot(connection, kind, run_ids=run_ids, image_format="svg")
    assert {f"run {run}" for run in run_ids} <= words(picture)
    pens = {(LINES[run % len(LINES)], DASHES[run % len(DASHES)]) for run in range(len(run_ids))}
    assert len(pens) == len(run_ids)


def test_the_name_of_a_file_tells_its_format() -> None:
    assert image_format_of(Path("plot.PNG")) == "png"
    assert image_format_of(Path("a/b.svg")) == "svg"
    with pytest.raises(InvalidInputError, match=r"End it in \.png or \.svg"):
        image_format_of(Path("plot.jpg"))


def test_a_picture_of_what_was_not_read_whole_says_so_and_marks_no_end(
    rover: sqlite3.Connection,
) -> None:
    ranges = [find_range(rover, Scope(run_id=1))]
    signals, _ = compose_signals(rover, ranges, ["pose.0"])
    way, _ = compose_trajectory(rover, ranges)
    (track,) = way.tracks
    cut = replace(way, tracks=[replace(track, path=replace(track.path, is_whole=False))])
    unread = replace(signals, unread=[Interval("", 60, 120)])
    shown: list[tuple[Any, Any]] = [
        (paint_signals, signals), (paint_signals, unread), (paint_trajectory, way),
        (paint_trajectory, cut),
    ]  # fmt: skip
    named = [{text for text, _ in texts_of(paint(plot, 900, 500)[0])} for paint, plot in shown]
    assert ["not all was read" in each for each in named] == [False, True, False, False]
    assert ["end (12.8, 1.00)" in each for each in named] == [False, False, True, False]
