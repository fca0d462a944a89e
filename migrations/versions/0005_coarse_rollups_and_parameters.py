"""Rollups of 500 s beside those of 10 s: a long recording is read fast as a whole.

They are made from those of 10 s while the server maintains the database, also of older recordings.

And parameters that a controller declares, and the values that they had in each run; breakpoints;
how many of its publish() calls a session records; trials. The views robot_now and robot_trajectory
know all the names under which the tools look for a robot's position and mode.

Revision ID: 0005
Revises: 0004
"""

import json

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

COUNTS = {
    "rows": "state rows that held the signal",
    "present": "of them with a value",
    "changes": "of the values, those unlike the one before in the bucket",
}
NUMBERS = {
    "first": "of numbers and flags (0, 1); null for text, as all that follows",
    "first_sim_time_s": None,
    "last": None,
    "last_sim_time_s": None,
    "min": None,
    "min_sim_time_s": "of the first such extreme",
    "max": None,
    "max_sim_time_s": "of the first such extreme",
    "sum": None,
    "squares": "sum of squared deviations from sum / count",
    "sines": "angles only: sum of sines",
    "cosines": "angles only: sum of cosines",
}
UUID = "random (version 4); names the row among those of all machines"
PROCESS = "which process of that pid; null where the system does not tell"
NOW_UTC = "strftime('%Y-%m-%d %H:%M:%f', v.wall_time_s, 'unixepoch')"
ROBOT_PARAMETER = f"""
CREATE VIEW robot_parameter AS
/* The values that parameters had in each run, each from a time on; true and false as text. */
SELECT r.name AS robot, v.run_id, v.name,
  CASE json_type(v.j) WHEN 'true' THEN 'true' WHEN 'false' THEN 'false'
    ELSE json_extract(v.j, '$') END AS value,
  p.unit, v.sim_time_s AS since_s, {NOW_UTC} AS utc, v.is_default, v.set_by, v.command_id
FROM (SELECT *, CASE WHEN json_valid(value) THEN value END AS j FROM parameter_value) v
JOIN run u ON u.id = v.run_id JOIN robot r ON r.id = u.robot_id
LEFT JOIN parameter p ON p.robot_id = u.robot_id AND p.name = v.name"""


def first_of(paths: str) -> str:
    """The first of these places in a state that holds something; null where it is no JSON."""
    found = ",\n    ".join(f"json_extract(j, '$.{path}')" for path in paths.split())
    return f"coalesce(\n    {found})"


def coordinate(usual: str, other: str) -> str:
    """The x (`key`) or y (`value`) of the first usual pair of two numbers, or of any branch."""
    return f"""coalesce(
    (SELECT json_extract(j, '$.' || {usual}) FROM json_each('{PAIRS}') p
      WHERE json_type(j, '$.' || p.key) {IS_NUMBER} AND json_type(j, '$.' || p.value) {IS_NUMBER}
      LIMIT 1),
    (SELECT {other}.value FROM json_tree(j) x JOIN json_tree(j) y ON y.parent = x.parent
      WHERE x.key = 'x' AND y.key = 'y' AND x.type {IS_NUMBER} AND y.type {IS_NUMBER}
        AND NOT EXISTS (SELECT 1 FROM json_each('{ELSEWHERE}') w WHERE
          instr(replace(lower({NAME.format("x.path")}), '_', '.') || '.', '.' || w.value || '.'))
      ORDER BY NOT EXISTS (SELECT 1 FROM json_each('{json.dumps(BRANCHES)}') w
        WHERE {NAME.format("x.path")} LIKE '%.' || w.value), {NAME.format("x.path")} LIMIT 1))"""


def word(words: str) -> str:
    """The text at the first of these names, or else at the shortest name that ends in one."""
    usual = ",\n    ".join(
        f"CASE WHEN json_type(j, '$.{each}') = 'text' THEN json_extract(j, '$.{each}') END"
        for each in words.split()
    )
    listed = ", ".join(f"'{each}'" for each in words.split())
    return f"""{usual},
    (SELECT value FROM json_tree(j) WHERE type = 'text' AND lower(key) IN ({listed})
      ORDER BY length({NAME.format("fullkey")}), {NAME.format("fullkey")} LIMIT 1)"""


# As webots_mcp/naming.py had them; a later change there takes a migration of its own.
IS_NUMBER = "IN ('integer', 'real')"
BRANCHES = ("pose", "position", "pos", "gps", "odometry", "odom", "location")
AXES = (("[0]", "[1]"), (".x", ".y"), (".x_m", ".y_m"))
ELSEWHERE = json.dumps([
    "accel", "acceleration", "accelerometer", "angular", "axis", "cmd", "command", "compass",
    "error", "force", "gravity", "gyro", "imu", "linear", "magnetometer", "offset", "speed",
    "torque", "twist", "vel", "velocity", "wind", "ball", "blob", "box", "desired",
    "destination", "goal", "image", "item", "marker", "object", "obstacle", "pixel",
    "reference", "setpoint", "target", "waypoint",
])  # fmt: skip
USUAL = [(branch + x, branch + y) for branch in BRANCHES for x, y in AXES]
PAIRS = json.dumps(dict([*USUAL, ("x", "y"), ("x_m", "y_m")]))
NAME = """replace(replace(replace({}, '"', ''), '[', '.'), ']', '')"""
OLD_POSITION = f"""
  {first_of("pose[0] pose.x position[0] position.x gps[0] gps.x x")} AS x_m,
  {first_of("pose[1] pose.y position[1] position.y gps[1] gps.y y")} AS y_m,"""
OLD_MODE = """
  CASE WHEN json_type(j, '$.mode') = 'text' THEN json_extract(j, '$.mode')
    WHEN json_type(j, '$.state') = 'text' THEN json_extract(j, '$.state') END AS mode"""
POSITION = f"""
  {coordinate("p.key", "x")} AS x_m,
  {coordinate("p.value", "y")} AS y_m,"""
MODE = f"""
  coalesce(
    {word("mode behaviour behavior action task phase")},
    {word("state status")}) AS mode"""


def upgrade() -> None:
    op.add_column(
        "run",
        sa.Column(
            "coarse_end",
            sa.Integer(),
            comment="buckets of coarse_rollup below it are complete; null before the first",
        ),
    )
    create_coarse_rollup()
    op.add_column(
        "session",
        sa.Column(
            "throttle_interval", sa.Integer(), comment="of so many publish() calls one is recorded"
        ),
    )
    create_breakpoint()
    create_parameter()
    create_parameter_value()
    create_trial_set()
    create_trial()
    if op.get_context().dialect.name == "sqlite":
        op.get_bind().exec_driver_sql(ROBOT_PARAMETER.strip())
        for view in ("robot_now", "robot_trajectory"):
            replace_in_view(view, {OLD_POSITION: POSITION, OLD_MODE: MODE})
        op.execute("PRAGMA user_version = 5")


def replace_in_view(view: str, texts: dict[str, str]) -> None:
    """Make a view again with other texts in their places."""
    connection = op.get_bind()
    found = f"SELECT sql FROM sqlite_master WHERE type = 'view' AND name = '{view}'"
    sql: str = connection.exec_driver_sql(found).scalar_one()
    connection.exec_driver_sql(f"DROP VIEW {view}")
    for old, new in texts.items():
        sql = sql.replace(old, new)
    connection.exec_driver_sql(sql)


def create_coarse_rollup() -> None:
    zero = sa.text("0")
    op.create_table(
        "coarse_rollup",
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column(
            "signal_id", sa.Integer(), nullable=False, comment="signal.id, of the run's robot"
        ),
        sa.Column("bucket", sa.Integer(), nullable=False, comment="floor(sim_time_s / 500)"),
        *(
            sa.Column(name, sa.Integer(), server_default=zero, nullable=False, comment=comment)
            for name, comment in COUNTS.items()
        ),
        *(sa.Column(name, sa.Float(), comment=comment) for name, comment in NUMBERS.items()),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_coarse_rollup_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("run_id", "signal_id", "bucket"),
        sqlite_with_rowid=False,
    )


def create_parameter() -> None:
    op.create_table(
        "parameter",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column(
            "session_id",
            sa.Integer(),
            nullable=False,
            comment="session.id of the controller that did",
        ),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False, comment="float, int, bool or str"),
        sa.Column("default_value", sa.Text(), nullable=False, comment="JSON value"),
        sa.Column("low", sa.Float(), comment="least value"),
        sa.Column("high", sa.Float(), comment="greatest value"),
        sa.Column("choices", sa.Text(), comment="JSON array: the only values that it may have"),
        sa.Column("doc", sa.Text(), nullable=False),
        sa.Column("unit", sa.Text()),
        sa.Column(
            "next_value",
            sa.Text(),
            comment="JSON value that it takes with the next reset of the world",
        ),
        sa.Column("declared_wall_time_s", sa.Float(), nullable=False),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_parameter_robot_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("robot_id", "name", name=op.f("uq_parameter_robot_id")),
        sqlite_autoincrement=True,
    )


def create_parameter_value() -> None:
    op.create_table(
        "parameter_value",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("value", sa.Text(), nullable=False, comment="JSON value"),
        sa.Column(
            "is_default", sa.Integer(), nullable=False, comment="1 where the code declared it"
        ),
        sa.Column(
            "set_by", sa.Text(), nullable=False, comment="code, environment, command or trial"
        ),
        sa.Column(
            "command_id",
            sa.Integer(),
            comment="command.id that set it, which may have been deleted since",
        ),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_parameter_value_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_parameter_value_run_id_name_id"), "parameter_value", ["run_id", "name", "id"]
    )


def create_breakpoint() -> None:
    op.create_table(
        "breakpoint",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer()),
        sa.Column("condition", sa.Text(), nullable=False, comment="see docs/conditions.md"),
        sa.Column("action", sa.Text(), nullable=False, comment="pause, log or keep"),
        sa.Column(
            "after_hits",
            sa.Integer(),
            server_default=sa.text("1"),
            nullable=False,
            comment="the action is taken from this hit of a run on",
        ),
        sa.Column(
            "enabled",
            sa.Integer(),
            server_default=sa.text("1"),
            nullable=False,
            comment="0 once the condition failed",
        ),
        sa.Column(
            "hits",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="how often it began to hold, in all runs",
        ),
        sa.Column("created_wall_time_s", sa.Float(), nullable=False),
        sa.Column(
            "created_by", sa.Text(), comment="mcp, cli or controller: its code, for session_id only"
        ),
        sa.Column("error", sa.Text(), comment="why the condition failed"),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_breakpoint_robot_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["session_id"],
            ["session.id"],
            name=op.f("fk_breakpoint_session_id"),
            ondelete="SET NULL",
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_breakpoint_robot_id"), "breakpoint", ["robot_id"])
    op.create_index(op.f("ix_breakpoint_session_id"), "breakpoint", ["session_id"])


def create_trial_set() -> None:
    op.create_table(
        "trial_set",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("uuid", sa.Text(), nullable=False, comment=UUID),
        sa.Column(
            "plan",
            sa.Text(),
            nullable=False,
            comment="JSON object",
        ),
        sa.Column("created_wall_time_s", sa.Float(), nullable=False),
        sa.Column("host", sa.Text(), comment="of the process at work"),
        sa.Column("pid", sa.Integer()),
        sa.Column("process", sa.Text(), comment=PROCESS),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_trial_set_uuid"), "trial_set", ["uuid"], unique=True)


def create_trial() -> None:
    op.create_table(
        "trial",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("trial_set_id", sa.Integer(), nullable=False),
        sa.Column("uuid", sa.Text(), nullable=False, comment=UUID),
        sa.Column("number", sa.Integer(), nullable=False, comment="its place in the set, from 1"),
        sa.Column("parameters", sa.Text(), nullable=False, comment="JSON object"),
        sa.Column(
            "status",
            sa.Text(),
            nullable=False,
            comment="waiting, running, then done, failed or pruned",
        ),
        sa.Column("run_id", sa.Integer()),
        sa.Column("score", sa.Float(), comment="if it is done"),
        sa.Column("ended_by", sa.Text(), comment="for_s, until or prune"),
        sa.Column("ended_sim_time_s", sa.Float(), comment="the end"),
        sa.Column("error", sa.Text(), comment="why it failed"),
        sa.Column("started_wall_time_s", sa.Float()),
        sa.Column("finished_wall_time_s", sa.Float()),
        sa.Column("pid", sa.Integer(), comment="of its simulator, while it runs"),
        sa.Column("process", sa.Text(), comment=PROCESS),
        sa.ForeignKeyConstraint(
            ["trial_set_id"],
            ["trial_set.id"],
            name=op.f("fk_trial_trial_set_id"),
            ondelete="CASCADE",
        ),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_trial_run_id"), ondelete="SET NULL"
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("trial_set_id", "number", name=op.f("uq_trial_trial_set_id")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_trial_run_id"), "trial", ["run_id"])
    op.create_index(op.f("ix_trial_uuid"), "trial", ["uuid"], unique=True)


def downgrade() -> None:
    op.drop_table("trial")
    op.drop_table("trial_set")
    op.drop_table("breakpoint")
    op.drop_column("session", "throttle_interval")
    if op.get_context().dialect.name == "sqlite":
        op.execute("DROP VIEW robot_parameter")
        for view in ("robot_now", "robot_trajectory"):
            replace_in_view(view, {POSITION: OLD_POSITION, MODE: OLD_MODE})
    op.drop_table("parameter_value")
    op.drop_table("parameter")
    op.drop_table("coarse_rollup")
    op.drop_column("run", "coarse_end")
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 4")
