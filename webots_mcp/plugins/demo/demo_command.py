"""`webots-mcp demo`: a conversation about a driving robot, with only this package installed.

A robot drives in the stand-in's arena: a real controller process that records into a real database.
An MCP server runs next to it, and a real MCP client asks it over stdio.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import shlex
import sys
import time
from collections.abc import AsyncGenerator, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

from webots_mcp.cli.options import Json, Parameter
from webots_mcp.cli.streams import rewrite
from webots_mcp.cli.terminal import answer_lines, print_json
from webots_mcp.contract import DATA_DIR_VARIABLE, DATABASE_NAME, host_name
from webots_mcp.database.connection import connect
from webots_mcp.database.files import full_path, whole_file
from webots_mcp.database.job_leases import give_back, holder_of, lease_of, take
from webots_mcp.database.processes import process_alive
from webots_mcp.errors import CommandRefusedError, NothingRecordedError, WebotsMCPError
from webots_mcp.extras.requirements import quoted
from webots_mcp.setup.client_entries import server_command
from webots_mcp.store.recording import Job, RecordingAccess

if TYPE_CHECKING:
    from mcp import Client
    from mcp.types import CallToolResult, ImageContent

    from webots_mcp.standin import Simulation


DEFAULT_DATA_DIR: Final = Path.home() / ".webots-mcp" / "demo"

Turn = tuple[str, str, dict[str, Any]]
# What a person would say, and the tool call that an assistant would make.
CONVERSATION: Final[tuple[Turn, ...]] = (
    ("What is the robot doing?", "webots_get_robot_state", {}),
    ("What do its sensors say?", "webots_get_sensors", {}),
    ("What does it see?", "webots_get_camera", {}),
    ("What can be tuned?", "webots_get_parameters", {}),
    ("Drive faster.", "webots_set_parameters", {"values": {"speed": 6.0}}),
    ("Pause.", "webots_simulation_control", {"command": "pause"}),
    ("Five steps.", "webots_simulation_control", {"command": "step", "steps": 5}),
    (
        "Which cruising speed gets farther in five seconds?",
        "webots_run_trials",
        {"parameters": {"speed": [3.0, 8.0]}, "score": "max(pose.x) - first(pose.x)", "for_s": 5},
    ),
    ("Go on.", "webots_simulation_control", {"command": "resume"}),
    ("Show me the arena.", "webots_take_screenshot", {}),
    (
        "Go on as fast as you can until its mode changes, at most 20 s.",
        "webots_run",
        {"until": "changed(mode)", "for_s": 20, "then": "as_before"},
    ),
    ("Watch it for five seconds.", "webots_monitor", {"duration_wall_s": 5}),
    ("What has each signal done since the start?", "webots_get_trends", {}),
    (
        "Since when, and how often, was it avoiding something or stuck?",
        "webots_find_events",
        {"kinds": ["change", "stuck"], "signals": ["mode"]},
    ),
    ("Draw the way it took.", "webots_plot", {"kind": "trajectory"}),
    ("Start over.", "webots_simulation_control", {"command": "reset"}),
    (  # Leaves a longer run as the newest one.
        "Drive for half a minute, as fast as you can, and stop there.",
        "webots_run",
        {"for_s": 30, "then": "pause"},
    ),
)
_JOB: Final = "demo"  # One process at a time does this job in a folder.


@dataclass(frozen=True)
class DemoLimits:
    """How long the demo waits, and how much it shows.

    Attributes:
        start_timeout_s: Wall time for the first state.
        answer_lines: Lines of an answer.
        rows: Rows of a table.
    """

    start_timeout_s: float = 30.0
    answer_lines: int = 24
    rows: int = 6


_LIMITS: Final = DemoLimits()


def demo(
    *,
    data_dir: Annotated[
        Path | None,
        Parameter(
            "--data-dir", metavar="DIR", help="Folder to record in. Default: ~/.webots-mcp/demo."
        ),
    ] = None,
    keep: Annotated[bool, Parameter("--keep", help="Keep the robot running until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Drive a simulated robot and ask it questions, in under 30 s and without Webots.

    With --json the conversation goes to stderr, and its answers to stdout as one object.
    """
    chosen = full_path(data_dir) if data_dir is not None else None
    run(chosen or DEFAULT_DATA_DIR, keep=keep, as_json=as_json)


def run(
    data_dir: Path = DEFAULT_DATA_DIR,
    *,
    keep: bool = False,
    as_json: bool = False,
    conversation: tuple[Turn, ...] = CONVERSATION,
) -> None:
    """Run the demo, and print each question with its answer.

    Args:
        data_dir: Folder of the database and the pictures.
        keep: Whether to keep the robot running until Ctrl-C, for other clients.
        as_json: Whether to print this to stderr, and one JSON object of the answers to stdout.
        conversation: The questions with their tool calls.

    Raises:
        CommandRefusedError: A demo is running in this folder.
        DatabaseError: The folder cannot be recorded in.
        NothingRecordedError: The controller recorded nothing.
        WebotsMCPError: The server answered with an error.
    """
    import anyio

    from webots_mcp.standin import Simulation
    from webots_mcp.standin.in_process import DEFAULT_WORLD

    recording = RecordingAccess(data_dir / DATABASE_NAME, data_dir)
    recording.create()  # Raises for an unusable folder, for which a robot would only wait.
    shown = contextlib.redirect_stdout(sys.stderr if as_json else sys.stdout)
    environment = {DATA_DIR_VARIABLE: str(data_dir)}
    with _alone(recording), Simulation(DEFAULT_WORLD, environment=environment) as simulation:
        with shown:
            _say(f"Running {DEFAULT_WORLD.name} on the stand-in simulator (this is not Webots) ...")
        _wait_for_rows(simulation, data_dir)
        with shown:
            answers = anyio.run(converse, data_dir, conversation)
            _show_database(data_dir)
            _show_connections(data_dir)
            _show_next_steps(data_dir, keep=keep)
        if as_json:
            print_json({"database": str(data_dir / DATABASE_NAME), "answers": answers})
        if keep:
            _keep(simulation)


@contextlib.contextmanager
def _alone(recording: RecordingAccess) -> Generator[None]:
    """Prevent a second demo in the same folder, whose robot would mix with this one.

    Raises:
        CommandRefusedError: A demo is running in this folder.
    """
    lease = lease_of(_JOB)
    with recording.writer() as connection:
        holder = holder_of(connection, _JOB)
        if not take(connection, lease, forced=holder is not None and _was_killed(holder)):
            raise CommandRefusedError(
                f"a demo is already running there ({recording.data_dir}): watch it with "
                f"'{_typed('view', recording.data_dir)}', end it with Ctrl-C, or name another "
                "folder with --data-dir"
            )
    with Job(recording, lease).renewed():
        try:
            yield
        finally:
            with recording.writer() as connection:
                give_back(connection, lease)


def _was_killed(holder: str) -> bool:
    """Return whether the process that took the lease is known to have ended."""
    host, pid, _ = holder.rsplit(" ", 2)
    return host == host_name() and not process_alive(int(pid), None, time.time())


def _wait_for_rows(simulation: Simulation, data_dir: Path) -> None:
    """Wait until the started controller has published and saved a picture.

    Raises:
        NothingRecordedError: It has not in time.
    """
    before = _newest_image(data_dir)
    try:
        simulation.wait_for(lambda: _newest_image(data_dir) > before, _LIMITS.start_timeout_s)
    except TimeoutError as error:
        raise NothingRecordedError(f"the demo's controller recorded nothing: {error}") from error


def _newest_image(data_dir: Path) -> int:
    database = data_dir / DATABASE_NAME
    if not database.exists():
        return 0
    with contextlib.closing(connect(database, "reader")) as connection:
        tables = connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'image'").fetchone()
        sql = "SELECT coalesce(max(id), 0) FROM image WHERE kind = 'camera'"
        return int(connection.execute(sql).fetchone()[0]) if tables else 0


async def converse(data_dir: Path, conversation: tuple[Turn, ...]) -> list[dict[str, Any]]:
    """Ask all questions and print the answers; return each question with its call and answer.

    Raises:
        WebotsMCPError: The server answered with an error.
    """
    answers: list[dict[str, Any]] = []
    async with _client(data_dir) as client:
        for question, tool, arguments in conversation:
            given = ", ".join(f"{name}={_as_json(arguments[name])}" for name in arguments)
            _say(f"\n> {question}\n  {tool}({given})")
            started_s = time.monotonic()
            result = await client.call_tool(tool, arguments, progress_callback=_show_progress)
            _clear_progress()
            _show(result)
            took_s = time.monotonic() - started_s
            _say(f"  ({took_s:.2f} s)")
            if result.is_error:
                break
            answers.append(
                {
                    "question": question,
                    "tool": tool,
                    "arguments": arguments,
                    "answer": _data_of(result) or "\n".join(_texts_of(result)),
                    "took_s": round(took_s, 3),
                }
            )
            if tool == "webots_plot":
                _save_plot(result, data_dir / f"{arguments.get('kind', 'signals')}.png")
        else:
            return answers
    # Raised after the client has ended: before, it would become a group of exceptions.
    raise WebotsMCPError("the demo's server answered with an error, see above")


@contextlib.asynccontextmanager
async def _client(data_dir: Path) -> AsyncGenerator[Client, None]:
    """Connect a client to its own server, whose warnings appear on stderr."""
    from mcp import Client, StdioServerParameters

    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "webots_mcp", "serve", "--data-dir", str(data_dir)],
        env=dict(os.environ),
    )
    async with Client(server) as client:
        yield client


async def _show_progress(progress: float, total: float | None, message: str | None) -> None:
    rewrite(sys.stdout, f"  {message or progress}")


def _clear_progress() -> None:
    rewrite(sys.stdout)


def _show(result: CallToolResult) -> None:
    """Print an answer for a person. An assistant gets the same as JSON."""
    if data := _data_of(result):
        return _show_answer(data)
    for text in _texts_of(result):
        _say(f"  {text}")
    for block in result.content:
        if block.type == "image":
            _say(f"  a picture for the assistant ({block.mime_type}, {len(_bytes(block))} bytes)")


def _data_of(result: CallToolResult) -> dict[str, Any] | None:
    """Return the data of an answer; None for pictures with captions, or an error."""
    if result.is_error or result.structured_content is not None:
        return None if result.is_error else result.structured_content
    found = (json.loads(text) for text in _texts_of(result) if text.startswith("{"))
    return next(found, None)


def _texts_of(result: CallToolResult) -> list[str]:
    return [block.text for block in result.content if block.type == "text"]


def _show_answer(answer: Mapping[str, Any]) -> None:
    """Print the first lines of an answer, and the number of further lines."""
    lines = list(answer_lines(answer, most_rows=_LIMITS.rows))
    for line in lines[: _LIMITS.answer_lines]:
        _say(f"    {line}")
    if len(lines) > _LIMITS.answer_lines:
        _say(f"    ... and {len(lines) - _LIMITS.answer_lines} more lines")


def _save_plot(result: CallToolResult, file: Path) -> None:
    """Save a plot. Unlike camera images and screenshots, it is in no file yet."""
    (image,) = (block for block in result.content if block.type == "image")
    with whole_file(file) as aside:
        aside.write_bytes(_bytes(image))
    _say(f"  The plot is saved: {file}")


def _bytes(image: ImageContent) -> bytes:
    return base64.b64decode(image.data)


def _as_json(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


def _show_database(data_dir: Path) -> None:
    database = shlex.quote(str(data_dir / DATABASE_NAME))
    _say(f"\nThe database: {database}\nThree questions for the sqlite3 shell:")
    for sql in (
        "SELECT sim_time_s, data ->> '$.mode' FROM state ORDER BY id DESC LIMIT 5",
        "SELECT action, status, result FROM command ORDER BY id DESC LIMIT 5",
        "SELECT id, start_reason, row_count, end_reason FROM run",
    ):
        _say(f'  sqlite3 {database} "{sql}"')


def _show_connections(data_dir: Path) -> None:
    """Print the entries of the page clients with the full paths of this environment."""
    command = server_command(data_dir)
    entry = {"mcpServers": {"webots": {"command": command[0], "args": command[1:]}}}
    _say("\nConnect an assistant to this recording. Claude Code by one line:")
    _say(f"  {quoted(['claude', 'mcp', 'add', 'webots', '--', *command])}")
    _say("Cursor and Claude Desktop by JSON (VS Code: servers instead of mcpServers):")
    _say(f"  {_as_json(entry)}")


def _show_next_steps(data_dir: Path, *, keep: bool) -> None:
    _say("\nNext, see the same in your browser: signals, the path, pictures, the log.")
    _say(f"  {_typed('view', data_dir)}")
    if not keep:
        _say("With 'webots-mcp demo --keep' the robot drives on, and the page's buttons steer it.")
    _say(
        "Then record your own robot: 'webots-mcp init' in your Webots project writes these entries"
    )
    _say("and shows what each controller needs. 'webots-mcp init --help' says more.")


def _typed(command: str, data_dir: Path) -> str:
    """Return a command on this recording that works with any PATH."""
    program = server_command(data_dir)
    place = program.index("serve")
    return quoted([*program[:place], command, *program[place + 1 :]])


def _keep(simulation: Simulation) -> None:
    simulation.resume()
    _say("\nThe robot keeps driving until Ctrl-C.")
    while simulation.is_running:
        time.sleep(0.2)


def _say(text: str) -> None:
    print(text, flush=True)
