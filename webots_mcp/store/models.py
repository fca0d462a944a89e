"""Define the tables; this is the one place where their columns are explained.

`sim_time_s` is simulation time, `wall_time_s` is Unix time, both in seconds. Ids are not reused
after a deletion (by AUTOINCREMENT, or see `State`), so "after this id" is a safe cursor. The
comments are part of the database: `.schema` in the `sqlite3` shell shows them.
"""

from __future__ import annotations

from typing import Any, ClassVar

from sqlalchemy import (
    BigInteger,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    Text,
    UniqueConstraint,
    text,
)
from sqlmodel import Field, SQLModel

from webots_mcp.store.chunks import Statistics

SQLModel.metadata.naming_convention = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "uq": "uq_%(table_name)s_%(column_0_name)s",
}
STATISTICS = Statistics._fields
_KEEP_IDS = {"sqlite_autoincrement": True}
_UUID = "random (version 4); names the row among those of all machines"
_HAS_ROLE = text("role IS NOT NULL")


def _id() -> Any:
    return Field(default=None, sa_column=Column("id", Integer, primary_key=True))


def _to(
    table: str, comment: str | None = None, *, nullable: bool = False, on_delete: str | None = None
) -> Any:
    """Return a reference to another table's id; a row that requires it is deleted with it."""
    on_delete = on_delete or ("SET NULL" if nullable else "CASCADE")
    key = ForeignKey(f"{table}.id", ondelete=on_delete)
    return Field(default=None, sa_column=Column(Integer, key, nullable=nullable, comment=comment))


def _column(kind: Any, comment: str | None = None, **options: Any) -> Any:
    options.setdefault("nullable", True)
    return Field(default=None, sa_column=Column(kind, comment=comment, **options))


def _text(comment: str | None = None, **options: Any) -> Any:
    return _column(Text, comment, **options)


def _number(comment: str | None = None, **options: Any) -> Any:
    return _column(Float, comment, **options)


def _count(comment: str | None = None) -> Any:
    return _column(Integer, comment, nullable=False, server_default=text("0"))


def _partial(name: str, where: str) -> Index:
    """Return an index of commands that holds only the few rows that are queried all the time."""
    condition = text(where)
    return Index(name, "robot_id", "id", sqlite_where=condition, postgresql_where=condition)


class Recording(SQLModel, table=True):
    """This database: its one row is created with the tables."""

    uuid: str = Field(sa_column=Column(Text, primary_key=True, comment=_UUID))
    created_wall_time_s: float = _number(nullable=False)
    reserved_state_id: int = _count(
        "no state gets this id or a smaller one: the newest states were deleted up to it"
    )


class RobotTable(SQLModel, table=True):
    """The name of a robot that was ever recorded."""

    __tablename__: ClassVar[Any] = "robot"
    __table_args__ = (_KEEP_IDS,)
    id: int | None = _id()
    name: str = _text(
        "Robot.name; #2 is appended where two live at once", nullable=False, unique=True
    )
    kind: str = _text("Robot, Supervisor, Observer; customData: without a bridge", nullable=False)
    devices: str | None = _text("JSON object: device name to its class")
    first_seen_wall_time_s: float = _number(nullable=False)
    last_seen_wall_time_s: float = _number(nullable=False)


class Session(SQLModel, table=True):
    """A controller process, or one of several bridges in it."""

    __table_args__ = (Index(None, "robot_id", "id"), Index(None, "uuid", unique=True), _KEEP_IDS)
    id: int | None = _id()
    robot_id: int = _to("robot")
    pid: int = _column(Integer, nullable=False)
    host: str = _text(nullable=False)
    instance: str = _text("which Webots started it: the same after a reload", nullable=False)
    controller: str | None = _text("path of the controller file")
    controller_sha256: str | None = _text()
    git_commit: str | None = _text("commit checked out around the controller file")
    versions: str | None = _text("JSON object: python, webots_mcp, sqlite")
    supervisor: bool = _column(Integer, "1 if it may control the simulation", nullable=False)
    actions: str | None = _text("JSON object: registered custom action to its docstring")
    started_wall_time_s: float = _number(nullable=False)
    last_seen_wall_time_s: float = _number("newest sign of life of its loop", nullable=False)
    last_poll_wall_time_s: float | None = _number("newest get_command(); null if never called")
    moved_wall_time_s: float | None = _number("when simulation time was last seen to grow")
    sim_time_s: float | None = _number("simulation time at last_seen_wall_time_s")
    pause_state: str | None = _text("paused or stepping while the bridge holds the loop")
    rows_waiting: int = _count("rows that still waited in the file beside or in memory")
    rows_dropped: int = _count("rows that could never be written")
    last_error: str | None = _text("newest thing that could not be recorded, and why")
    ended_wall_time_s: float | None = _number()
    end_reason: str | None = _text("finished, reload, crashed, superseded")
    uuid: str | None = _text(_UUID)
    process: str | None = _text("which process of that pid; null where the system does not tell")
    last_seen_monotonic_s: float | None = _number(
        "the host's monotonic clock at last_seen_wall_time_s"
    )
    extern: bool | None = _column(Integer, "1 where nobody starts the controller again")
    mode_before_pause: str | None = _text("simulation mode to go back to when the pause ends")
    last_adopted_entry: int = _count("number of the last entry taken in from its file beside")
    throttle_interval: int | None = _column(Integer, "of so many publish() calls one is recorded")


class Run(SQLModel, table=True):
    """An interval of rising simulation time in a session; a reset or a reload begins the next."""

    __table_args__ = (
        Index(None, "robot_id", "id"),
        Index(None, "session_id"),
        Index(None, "uuid", unique=True),
        _KEEP_IDS,
    )
    id: int | None = _id()
    session_id: int = _to("session")
    robot_id: int = _to("robot")
    world: str | None = _text("path of the world file")
    basic_time_step_ms: float | None = _number()
    start_reason: str = _text("start, reset or reload", nullable=False)
    started_wall_time_s: float = _number(nullable=False)
    started_sim_time_s: float = _number(nullable=False)
    last_wall_time_s: float = _number("last sign of life", nullable=False)
    last_sim_time_s: float = _number(nullable=False)
    ended_wall_time_s: float | None = _number()
    end_reason: str | None = _text("finished, reset, reload, crashed, superseded")
    row_count: int = _count("state rows, as of last_wall_time_s")
    label: str | None = _text()
    note: str | None = _text()
    keep: bool = _count("1: retention deletes nothing of this run")
    purged_rows: int = _count("of the rows, those that retention has deleted")
    is_chunked: bool = _count("1 once it has ended and none of its rows wait for a chunk")
    uuid: str | None = _text(_UUID)
    own_wall_s: float | None = _number(
        "wall time in the controller's own code, over its steps; null where none was seen"
    )
    step_wait_wall_s: float | None = _number("wall time in step(), waiting for Webots")
    steps: int | None = _column(Integer, "from the end of one to the end of the next")


class State(SQLModel, table=True):
    """What one call of publish() recorded.

    AUTOINCREMENT would write another page of the file with each row. Instead, a trigger notes the
    id of a deleted newest state in `recording.reserved_state_id`, and later states get greater ids.
    """

    __table_args__ = (Index(None, "run_id", "sim_time_s"),)
    id: int | None = _id()
    run_id: int = _to("run")
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    data: str = _text("JSON object", nullable=False)
    replaced: str | None = _text(
        "JSON object: path of a replaced value to what it was (nan, inf, ...)"
    )


class Signal(SQLModel, table=True):
    """A number, flag or text that a robot's states hold, by its dotted name."""

    __table_args__ = (
        UniqueConstraint("robot_id", "name"),
        Index(None, "robot_id", "role", sqlite_where=_HAS_ROLE, postgresql_where=_HAS_ROLE),
        _KEEP_IDS,
    )
    id: int | None = _id()
    robot_id: int = _to("robot")
    name: str = _text("dotted: pose.0, sensors.front, lidar.min", nullable=False)
    kind: str = _text("num, bool, text, angle (radians), null (no value yet)", nullable=False)
    unit: str | None = _text("where the name tells it")
    path: str = _text("for json_extract(state.data, path)", nullable=False)
    reduction: str | None = _text("count, min, max, mean or argmin of the long array at path")
    role: str | None = _text(
        "x, y, z, yaw, mode, speed, commanded_speed, wheel or commanded_wheel; x2 without an x"
    )
    first_seen_wall_time_s: float = _number(nullable=False)
    min: float | None = _number("of all numbers that were put into chunks")
    max: float | None = _number()


class SignalMeaning(SQLModel, table=True):
    """A statement about the meaning of a signal, declared by somebody or known from its device.

    If several statements exist, the newest of `mcp` and `cli` counts, then `project`, `controller`
    and `bridge`.
    """

    __tablename__: ClassVar[Any] = "meaning"
    __table_args__ = (
        UniqueConstraint("robot_id", "name", "source", "set_by"),
        _KEEP_IDS,
    )
    id: int | None = _id()
    robot_id: int | None = _to("robot", "null: of robot_name", nullable=True, on_delete="CASCADE")
    name: str = _text("signal.name, or a pattern in which * is any text", nullable=False)
    source: str = _text("declared or device", nullable=False)
    quantity: str | None = _text("speed, wheel speed, distance, ...")
    role: str | None = _text("measured, commanded, target or limit")
    unit: str | None = _text()
    target_of: str | None = _text("the signal whose target it is")
    same_as: str | None = _text("the signal that measures the same")
    side: str | None = _text()
    low: float | None = _number()
    high: float | None = _number()
    set_wall_time_s: float = _number(nullable=False)
    set_by: str = _text(
        "mcp, cli, project (its file), controller (its code), bridge (the device)", nullable=False
    )
    why: str | None = _text("of a device: its type, model and sampling period")
    robot_name: str | None = _text("of the project's file: a robot's, or * for all")


class RowGroup(SQLModel, table=True):
    """About 1,024 consecutive state rows of a run whose values are stored in chunks.

    The rows themselves may have been deleted since.
    """

    __tablename__: ClassVar[Any] = "row_group"
    __table_args__ = (Index(None, "run_id", "start_sim_time_s"), _KEEP_IDS)
    id: int | None = _id()
    run_id: int = _to("run")
    start_sim_time_s: float = _number("of the first row", nullable=False)
    end_sim_time_s: float = _number("of the last row", nullable=False)
    last_state_id: int = _column(Integer, "state.id of the last row", nullable=False)
    max_state_id: int = _column(Integer, "the greatest state.id among them", nullable=False)
    row_count: int = _column(Integer, nullable=False)
    stored_row_count: int = _column(
        Integer, "of them, those that retention has left in state", nullable=False
    )
    stored_row_bytes: float = _number("that one of those takes on the disk", nullable=False)
    lost_value_count: int = _column(
        Integer, "that states of it had and chunks cannot hold as they were", nullable=False
    )
    chunk_bytes: int = _column(Integer, "that its chunks take on the disk", nullable=False)
    is_complete: bool = _column(Integer, "1 once all of its chunks are there", nullable=False)


class Chunk(SQLModel, table=True):
    """The values of one signal in a group of rows, compressed, with their statistics."""

    __table_args__ = (
        Index("ix_chunk_statistics", "run_id", "signal_id", "group_id", *STATISTICS),
        Index(None, "group_id"),
    )
    id: int | None = _id()
    group_id: int = _to("row_group")
    run_id: int = _column(Integer, nullable=False)
    signal_id: int = _column(
        Integer,
        "signal.id; 0: simulation times, -1: wall times, -2: ids of the state rows",
        nullable=False,
    )
    row_count: int = _column(Integer, "rows whose state has the signal", nullable=False)
    value_count: int = _column(Integer, "of them with a value", nullable=False)
    change_count: int = _column(Integer, "values unlike the one before", nullable=False)
    first: float | None = _number("of numbers and flags (0, 1), as all that follows")
    last: float | None = _number()
    min: float | None = _number()
    max: float | None = _number()
    sum: float | None = _number()
    squared_deviations: float | None = _number("sum of squared deviations from the mean")
    largest_step: float | None = _number("largest difference of values that follow each other")
    codec: str = _text("how numbers are compressed", nullable=False)
    numbers: bytes | None = _column(LargeBinary, "CRC-32, then the numbers compressed")
    codes: bytes | None = _column(
        LargeBinary, "zlib: for each row 0 a number, 1 no such key, else 2 + the place of its label"
    )
    labels: str | None = _text("JSON array; an item that is an array says what was replaced")


class Watermark(SQLModel, table=True):
    """The state row up to which all rows of all runs were examined for a derived table."""

    name: str = Field(sa_column=Column(Text, primary_key=True, comment="chunk"))
    state_id: int = _column(Integer, nullable=False)


class Log(SQLModel, table=True):
    """A line that the controller or the bridge logged, or a line of Webots' console."""

    __table_args__ = (Index(None, "run_id", "sim_time_s"), _KEEP_IDS)
    id: int | None = _id()
    run_id: int = _to("run")
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    level: str = _text("debug, info, ... critical", nullable=False)
    source: str = _text("controller, bridge, console or webots", nullable=False)
    message: str = _text(nullable=False)
    logger: str | None = _text("name of the Python logger, where one logged it")


class ConsoleLine(SQLModel, table=True):
    """A line of Webots' console that waits for a run of its simulation.

    Afterwards it is a log row.
    """

    __tablename__: ClassVar[Any] = "console_line"
    __table_args__ = (_KEEP_IDS,)
    id: int | None = _id()
    instance: str = _text("session.instance of who said it", nullable=False)
    wall_time_s: float = _number(nullable=False)
    level: str = _text(nullable=False)
    source: str = _text(
        "webots, or console: a controller, not told which; as in log later on", nullable=False
    )
    message: str = _text(nullable=False)
    logger: str | None = _text("stdout or stderr")


class EventTable(SQLModel, table=True):
    """Something noticed when it happened."""

    __tablename__: ClassVar[Any] = "event"

    __table_args__ = (Index(None, "run_id", "sim_time_s"), _KEEP_IDS)
    id: int | None = _id()
    run_id: int = _to("run")
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    kind: str = _text(
        "change, start, reset, reload, pause, resume, dropped, storage, ...", nullable=False
    )
    name: str | None = _text("the signal that changed, where one did")
    data: str | None = _text("JSON object")


class Command(SQLModel, table=True):
    """A request to a robot and its outcome: claimed by one session, at most once."""

    __table_args__ = (
        _partial("ix_command_pending", "status = 'pending'"),
        _partial("ix_command_claimed", "status = 'claimed'"),
        Index(None, "session_id"),
        _KEEP_IDS,
    )
    id: int | None = _id()
    robot_id: int = _to("robot")
    action: str = _text(nullable=False)
    params: str = _text("JSON object", nullable=False)
    status: str = _text(
        "pending, claimed, then one of done, failed, expired, cancelled, lost", nullable=False
    )
    requested_by: str | None = _text()
    idempotency_key: str | None = _text("the same key makes no second command", unique=True)
    created_wall_time_s: float = _number(nullable=False)
    expires_wall_time_s: float = _number("if not claimed by then, never run", nullable=False)
    claimed_wall_time_s: float | None = _number()
    claimed_sim_time_s: float | None = _number()
    session_id: int | None = _to("session", nullable=True)
    issued_wall_time_s: float | None = _number("when a reset or reload was asked of Webots")
    finished_wall_time_s: float | None = _number()
    finished_sim_time_s: float | None = _number()
    result: str | None = _text("JSON value")
    error: str | None = _text()
    request_id: int | None = _column(Integer, "the row of request that it was sent for")


class ClientRequest(SQLModel, table=True):
    """A request that changes something: who sent it, and whether it was allowed.

    Rows are never deleted, and the request itself cannot be changed.
    """

    __tablename__: ClassVar[Any] = "request"
    __table_args__ = (Index(None, "run_id"), Index(None, "uuid", unique=True), _KEEP_IDS)
    id: int | None = _id()
    uuid: str = _text(_UUID, nullable=False)
    wall_time_s: float = _number(nullable=False)
    run_id: int | None = _to("run", "that went on then", nullable=True)
    sim_time_s: float | None = _number("of its newest row then")
    client: str = _text("the name of the program that asked", nullable=False)
    client_version: str = _text(nullable=False)
    transport: str = _text("stdio, http, cli or page", nullable=False)
    tool: str = _text("or the command of the command line", nullable=False)
    arguments: str = _text("JSON object; without secrets, cut where it is long", nullable=False)
    rule: str | None = _text("by which it was refused: file, line, and what stands there")
    finished_wall_time_s: float | None = _number()
    outcome: str | None = _text("answered, refused, what became of its command, or an error")
    purged_commands: str | None = _text("JSON array of [id, action, status] that retention deleted")


class Breakpoint(SQLModel, table=True):
    """A condition that a robot's bridge checks for each published state, and what it does then.

    An expectation is stored as a breakpoint whose condition is that the expectation does not hold.
    """

    __table_args__ = (Index(None, "robot_id"), Index(None, "session_id"), _KEEP_IDS)
    id: int | None = _id()
    robot_id: int | None = _to("robot", "null: of robot_name", nullable=True, on_delete="CASCADE")
    session_id: int | None = _to("session", nullable=True)
    condition: str = _text("see webots-mcp help conditions", nullable=False)
    action: str = _text("pause, log or keep", nullable=False)
    after_hits: int = _column(
        Integer,
        "the action is taken from this hit of a run on",
        nullable=False,
        server_default=text("1"),
    )
    enabled: bool = _column(
        Integer, "0 once the condition failed", nullable=False, server_default=text("1")
    )
    hit_count: int = _count("how often it began to hold, in all runs")
    created_wall_time_s: float = _number(nullable=False)
    created_by: str | None = _text(
        "mcp, cli, project (its file), or controller: its code, for session_id only"
    )
    error: str | None = _text("why the condition failed")
    name: str | None = _text("of an expectation")
    expects: str | None = _text("the condition that is expected to hold; null of a breakpoint")
    during: str | None = _text("while this holds; null: always")
    robot_name: str | None = _text("of the project's expectations: a robot's, or * for all")


class KeptStretch(SQLModel, table=True):
    """Seconds of a run that are kept at full rate: each call of `publish` is a row."""

    __tablename__: ClassVar[Any] = "kept_stretch"
    __table_args__ = (
        Index(None, "run_id", "start_sim_time_s"),
        Index(None, "uuid", unique=True),
        _KEEP_IDS,
    )
    id: int | None = _id()
    run_id: int = _to("run")
    uuid: str = _text(_UUID, nullable=False)
    start_sim_time_s: float = _number(nullable=False)
    end_sim_time_s: float = _number("ahead of the newest row while it goes on", nullable=False)
    wall_time_s: float = _number("when it was asked for", nullable=False)
    reason: str = _text("why it is kept", nullable=False)


class KeptState(SQLModel, table=True):
    """A call of `publish` that only a full-rate segment has; the other calls are in `state`."""

    __tablename__: ClassVar[Any] = "kept_state"
    __table_args__ = (
        Index(None, "run_id", "sim_time_s"),
        UniqueConstraint("run_id", "call"),
        _KEEP_IDS,
    )
    id: int | None = _id()
    run_id: int = _to("run")
    call: int | None = _column(
        Integer, "its number in the session; null where retention moved it here from state"
    )
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    data: str = _text("JSON object", nullable=False)
    replaced: str | None = _text("as in state")


class Image(SQLModel, table=True):
    """A camera frame or a screenshot in a file of the data folder."""

    __table_args__ = (Index(None, "run_id", "sim_time_s"), _KEEP_IDS)
    id: int | None = _id()
    run_id: int = _to("run")
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    kind: str = _text("camera, screenshot or kept (of a kept stretch)", nullable=False)
    device: str | None = _text("name of the camera")
    path: str = _text("relative to the data folder", nullable=False)
    width: int = _column(Integer, "pixels", nullable=False)
    height: int = _column(Integer, "pixels", nullable=False)
    size_bytes: int = _column(Integer, "of the file", nullable=False)


class ParameterTable(SQLModel, table=True):
    """A parameter as a robot's controller declared it last."""

    __tablename__: ClassVar[Any] = "parameter"

    __table_args__ = (UniqueConstraint("robot_id", "name"), _KEEP_IDS)
    id: int | None = _id()
    robot_id: int = _to("robot")
    session_id: int = _column(Integer, "session.id of the controller that did", nullable=False)
    name: str = _text(nullable=False)
    kind: str = _text("float, int, bool or str", nullable=False)
    default_value: str = _text("JSON value", nullable=False)
    low: float | None = _number("least value")
    high: float | None = _number("greatest value")
    choices: str | None = _text("JSON array: the only values that it may have")
    doc: str = _text(nullable=False)
    unit: str | None = _text()
    next_value: str | None = _text("JSON value that it takes with the next reset of the world")
    declared_wall_time_s: float = _number(nullable=False)


class ParameterValue(SQLModel, table=True):
    """A value that a parameter had in a run, from this time on; the first is its start value."""

    __tablename__: ClassVar[Any] = "parameter_value"
    __table_args__ = (Index(None, "run_id", "name", "id"), _KEEP_IDS)
    id: int | None = _id()
    run_id: int = _to("run")
    name: str = _text(nullable=False)
    sim_time_s: float = _number(nullable=False)
    wall_time_s: float = _number(nullable=False)
    value: str = _text("JSON value", nullable=False)
    is_default: bool = _column(Integer, "1 where the code declared it", nullable=False)
    set_by: str = _text("code, environment, command or trial", nullable=False)
    command_id: int | None = _column(
        Integer, "command.id that set it, which may have been deleted since"
    )


class TrialSet(SQLModel, table=True):
    """Runs with chosen parameters, each scored, to find the best."""

    __tablename__: ClassVar[Any] = "trial_set"
    __table_args__ = (
        Index(None, "uuid", unique=True),
        Index(None, "robot_id"),
        Index(None, "session_id"),
        _KEEP_IDS,
    )
    id: int | None = _id()
    uuid: str = _text(_UUID, nullable=False)
    plan: str = _text("JSON object", nullable=False)
    created_wall_time_s: float = _number(nullable=False)
    host: str | None = _text("of the process at work")
    pid: int | None = _column(Integer)
    process: str | None = _text("which process of that pid; null where the system does not tell")
    robot_id: int | None = _to(
        "robot", "in whose simulation the trials run; null: each in one of its own", nullable=True
    )
    session_id: int | None = _to("session", "of the controller that was tried", nullable=True)
    former_values: str | None = _text("JSON object: its parameters before, until they are set back")
    stop_reason: str | None = _text("why it does not go on although trials wait")


class Trial(SQLModel, table=True):
    """One run of a trial set, before, while and after it happens."""

    __table_args__ = (
        UniqueConstraint("trial_set_id", "number"),
        Index(None, "run_id"),
        Index(None, "uuid", unique=True),
        _KEEP_IDS,
    )
    id: int | None = _id()
    trial_set_id: int = _to("trial_set")
    uuid: str = _text(_UUID, nullable=False)
    number: int = _column(Integer, "its place in the set, from 1", nullable=False)
    parameters: str = _text("JSON object", nullable=False)
    status: str = _text("waiting, running, then done, failed or pruned", nullable=False)
    run_id: int | None = _to("run", nullable=True)
    score: float | None = _number("if it is done")
    ended_by: str | None = _text("for_s, until or prune")
    ended_sim_time_s: float | None = _number("the end")
    error: str | None = _text("why it failed")
    started_wall_time_s: float | None = _number()
    finished_wall_time_s: float | None = _number()
    pid: int | None = _column(Integer, "of its simulator, while it runs")
    process: str | None = _text("which process of that pid; null where the system does not tell")


class Lease(SQLModel, table=True):
    """The process that alone may do a job (today: `maintainer`), and until when."""

    name: str = Field(sa_column=Column(Text, primary_key=True))
    holder: str = _text(nullable=False)
    until_wall_time_s: float = _number(nullable=False)


class RetentionLimit(SQLModel, table=True):
    """How much of a kind is kept.

    A limit without a number keeps all, a kind without a row has the default.
    """

    __tablename__: ClassVar[Any] = "retention_limit"
    kind: str = Field(
        sa_column=Column(
            Text, primary_key=True, comment="state, kept_state, chunk, log, event, image or run"
        )
    )
    size_bytes: int | None = _column(BigInteger, "on the disk; of pictures their files")
    row_count: int | None = _column(BigInteger)
    age_s: float | None = _number("since it was recorded, in wall time")
    outlive_factor: float | None = _number(
        "run only: what is left of one stays so many times longer than its chunks; 0 for ever"
    )
    set_by: str = _text("serve, prune or retain", nullable=False)
    set_wall_time_s: float = _number(nullable=False)
