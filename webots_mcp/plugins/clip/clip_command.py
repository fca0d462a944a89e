"""The command that writes a clip to any file; the tool of assistants is in `get_clip`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from webots_mcp.cli.options import (
    HERE,
    Id,
    Json,
    Parameter,
    Robot,
    RunId,
    Where,
    make_chunks_first,
    only_reading,
)
from webots_mcp.cli.terminal import print_answer, print_json
from webots_mcp.database.files import placed
from webots_mcp.errors import InvalidInputError


@only_reading
def clip(
    *,
    event_id: Annotated[
        Id | None,
        Parameter("--event", metavar="ID", help="Stored event to show, from 'webots-mcp events'."),
    ] = None,
    at_s: Annotated[
        float | None,
        Parameter(
            "--at",
            metavar="S",
            help="Simulated time in seconds to show instead. Default: the newest breakpoint hit or "
            "violation, else the end of the run.",
        ),
    ] = None,
    before_s: Annotated[
        float, Parameter("--before", metavar="S", help="Seconds to show before it. Default: 3.")
    ] = 3.0,
    after_s: Annotated[
        float, Parameter("--after", metavar="S", help="Seconds to show after it. Default: 2.")
    ] = 2.0,
    signals: Annotated[
        list[str] | None,
        Parameter(
            "--signal",
            metavar="SIGNAL",
            help="Signal to draw as a curve, up to three times. Default: those of the event, then "
            "those that changed most.",
        ),
    ] = None,
    camera: Annotated[
        str,
        Parameter(
            "--camera",
            metavar="CAMERA",
            help="Camera name. Default: the camera with most frames in that time.",
        ),
    ] = "",
    as_map: Annotated[
        bool,
        Parameter("--map", negative=(), help="Show the map, even if a camera has frames."),
    ] = False,
    speed: Annotated[
        float,
        Parameter(
            "--speed",
            metavar="X",
            help="Speed of the animation: 0.5 is half of real time. Default: 1.",
        ),
    ] = 1.0,
    output: Annotated[
        Path,
        Parameter(
            ("-o", "--output"),
            metavar="FILE",
            help="File to write: .webp or .gif. Default: clip.webp.",
        ),
    ] = Path("clip.webp"),
    sheet: Annotated[
        Path | None,
        Parameter(
            "--sheet",
            metavar="FILE",
            help="Also write the contact sheet to FILE (.jpg or .png).",
        ),
    ] = None,
    run_id: RunId = None,
    robot: Robot = None,
    json: Json = False,
    recorded: Where = HERE,
) -> None:
    """Save the seconds around a moment as an animated picture.

        webots-mcp clip --at 12.4 --before 5 -o crash.webp

    It shows the recorded camera frames, or the robot on the map, with clock, mode and up to three
    curves. The file has at most 3 MB.
    """  # fmt: skip
    from webots_mcp.plugins.clip.clip import make_clip
    from webots_mcp.plugins.clip.get_clip import facts_of
    from webots_mcp.plugins.clip.moment import moment_at, moment_of_event, newest_moment
    from webots_mcp.store.reading.ranges import find_subject
    from webots_mcp.store.run_rows import fetch_run

    form = output.suffix.lower().removeprefix(".")
    if form not in ("webp", "gif"):
        raise InvalidInputError(
            f"{output.name!r} is not the name of a clip. End it in .webp or .gif."
        )
    if not 0.05 <= speed <= 20:
        raise InvalidInputError(f"--speed {speed:g} must be from 0.05 to 20.")
    if event_id is not None and at_s is not None:
        raise InvalidInputError("--event and --at name two moments. Leave one of them out.")
    recording = recorded.recording()
    make_chunks_first(recording)
    with recorded.reader() as connection:
        if event_id is not None:
            moment = moment_of_event(connection, event_id)
        else:
            chosen = run_id or find_subject(connection, robot).run_id
            run = fetch_run(connection, chosen)
            moment = (
                newest_moment(connection, run) if at_s is None else moment_at(connection, run, at_s)
            )
        made = make_clip(
            connection, recording.data_dir, moment, before_s=before_s, after_s=after_s,
            signals=signals or (), camera=camera, view="map" if as_map else None, speed=speed,
            image_format="gif" if form == "gif" else "webp",
        )  # fmt: skip
    with placed(output) as aside:
        aside.write_bytes(made.data)
    facts = {"file": str(output)} | facts_of(made)
    if sheet is not None:
        _write_sheet(sheet, made.sheet)
        facts["sheet"] = str(sheet)
    if json:
        return print_json(facts)
    print_answer({"summary": f"Wrote {output}: {facts.pop('shows')}."} | facts)


def _write_sheet(file: Path, sheet: bytes) -> None:
    """Write the contact sheet in the format of the file's name."""
    import io

    from PIL import Image

    form = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG"}.get(file.suffix.lower())
    if form is None:
        raise InvalidInputError(
            f"{file.name!r} is not the name of a picture. End it in .jpg or .png."
        )
    picture: Any = Image.open(io.BytesIO(sheet))
    with placed(file) as aside:
        picture.convert("RGB").save(aside, form)
