"""The main job: robots, sessions, runs, states, logs, events, commands, images.

Revision ID: 0001
Revises:
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

TABLES = ("image", "event", "log", "state", "command", "run", "session", "robot", "lease")


def upgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA application_id = 1463962947")
        op.execute("PRAGMA user_version = 1")
    op.create_table(
        "lease",
        sa.Column("name", sa.Text(), nullable=False),
        sa.Column("holder", sa.Text(), nullable=False),
        sa.Column("until_wall_time_s", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )
    op.create_table(
        "robot",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column(
            "name",
            sa.Text(),
            nullable=False,
            comment="Robot.name; #2 is appended where two live at once",
        ),
        sa.Column("kind", sa.Text(), nullable=False, comment="Robot or Supervisor"),
        sa.Column(
            "devices", sa.Text(), nullable=True, comment="JSON object: device name to its class"
        ),
        sa.Column("first_seen_wall_time_s", sa.Float(), nullable=False),
        sa.Column("last_seen_wall_time_s", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("name", name=op.f("uq_robot_name")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "session",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("pid", sa.Integer(), nullable=False),
        sa.Column("host", sa.Text(), nullable=False),
        sa.Column(
            "instance",
            sa.Text(),
            nullable=False,
            comment="which Webots started it: the same after a reload",
        ),
        sa.Column("controller", sa.Text(), nullable=True, comment="path of the controller file"),
        sa.Column("controller_sha256", sa.Text(), nullable=True),
        sa.Column(
            "git_commit",
            sa.Text(),
            nullable=True,
            comment="commit checked out around the controller file",
        ),
        sa.Column(
            "versions", sa.Text(), nullable=True, comment="JSON object: python, webots_mcp, sqlite"
        ),
        sa.Column(
            "supervisor", sa.Integer(), nullable=False, comment="1 if it may control the simulation"
        ),
        sa.Column(
            "actions",
            sa.Text(),
            nullable=True,
            comment="JSON object: registered custom action to its docstring",
        ),
        sa.Column("started_wall_time_s", sa.Float(), nullable=False),
        sa.Column(
            "last_seen_wall_time_s",
            sa.Float(),
            nullable=False,
            comment="newest sign of life of its loop",
        ),
        sa.Column(
            "last_poll_wall_time_s",
            sa.Float(),
            nullable=True,
            comment="newest get_command(); null if never called",
        ),
        sa.Column(
            "moved_wall_time_s",
            sa.Float(),
            nullable=True,
            comment="when simulation time was last seen to grow",
        ),
        sa.Column(
            "sim_time_s",
            sa.Float(),
            nullable=True,
            comment="simulation time at last_seen_wall_time_s",
        ),
        sa.Column(
            "hold",
            sa.Text(),
            nullable=True,
            comment="paused or stepping while the bridge holds the loop",
        ),
        sa.Column(
            "rows_waiting",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="rows that still waited in the file beside or in memory",
        ),
        sa.Column(
            "rows_dropped",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="rows that could never be written",
        ),
        sa.Column(
            "last_error",
            sa.Text(),
            nullable=True,
            comment="newest thing that could not be recorded, and why",
        ),
        sa.Column("ended_wall_time_s", sa.Float(), nullable=True),
        sa.Column(
            "end_reason", sa.Text(), nullable=True, comment="finished, reload, crashed, replaced"
        ),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_session_robot_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_session_robot_id_id"), "session", ["robot_id", "id"], unique=False)
    op.create_table(
        "command",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("action", sa.Text(), nullable=False),
        sa.Column("params", sa.Text(), nullable=False, comment="JSON object"),
        sa.Column(
            "status",
            sa.Text(),
            nullable=False,
            comment="pending, claimed, then one of done, failed, expired, cancelled, lost",
        ),
        sa.Column("requested_by", sa.Text(), nullable=True),
        sa.Column(
            "idempotency_key",
            sa.Text(),
            nullable=True,
            comment="the same key makes no second command",
        ),
        sa.Column("created_wall_time_s", sa.Float(), nullable=False),
        sa.Column(
            "expires_wall_time_s",
            sa.Float(),
            nullable=False,
            comment="if not claimed by then, never run",
        ),
        sa.Column("claimed_wall_time_s", sa.Float(), nullable=True),
        sa.Column("claimed_sim_time_s", sa.Float(), nullable=True),
        sa.Column("session_id", sa.Integer(), nullable=True),
        sa.Column(
            "issued_wall_time_s",
            sa.Float(),
            nullable=True,
            comment="when a reset or reload was asked of Webots",
        ),
        sa.Column("finished_wall_time_s", sa.Float(), nullable=True),
        sa.Column("finished_sim_time_s", sa.Float(), nullable=True),
        sa.Column("result", sa.Text(), nullable=True, comment="JSON value"),
        sa.Column("error", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_command_robot_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["session_id"], ["session.id"], name=op.f("fk_command_session_id"), ondelete="SET NULL"
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("idempotency_key", name=op.f("uq_command_idempotency_key")),
        sqlite_autoincrement=True,
    )
    op.create_index(
        "ix_command_claimed",
        "command",
        ["robot_id", "id"],
        unique=False,
        sqlite_where=sa.text("status = 'claimed'"),
        postgresql_where=sa.text("status = 'claimed'"),
    )
    op.create_index(
        "ix_command_pending",
        "command",
        ["robot_id", "id"],
        unique=False,
        sqlite_where=sa.text("status = 'pending'"),
        postgresql_where=sa.text("status = 'pending'"),
    )
    op.create_table(
        "run",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("session_id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column("world", sa.Text(), nullable=True, comment="path of the world file"),
        sa.Column("basic_time_step_ms", sa.Float(), nullable=True),
        sa.Column("start_reason", sa.Text(), nullable=False, comment="start, reset or reload"),
        sa.Column("started_wall_time_s", sa.Float(), nullable=False),
        sa.Column("started_sim_time_s", sa.Float(), nullable=False),
        sa.Column("last_wall_time_s", sa.Float(), nullable=False, comment="last sign of life"),
        sa.Column("last_sim_time_s", sa.Float(), nullable=False),
        sa.Column("ended_wall_time_s", sa.Float(), nullable=True),
        sa.Column(
            "end_reason",
            sa.Text(),
            nullable=True,
            comment="finished, reset, reload, crashed, replaced",
        ),
        sa.Column(
            "rows",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="state rows, as of last_wall_time_s",
        ),
        sa.Column("label", sa.Text(), nullable=True),
        sa.Column("note", sa.Text(), nullable=True),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_run_robot_id"), ondelete="CASCADE"
        ),
        sa.ForeignKeyConstraint(
            ["session_id"], ["session.id"], name=op.f("fk_run_session_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_run_robot_id_id"), "run", ["robot_id", "id"], unique=False)
    op.create_index(op.f("ix_run_session_id"), "run", ["session_id"], unique=False)
    op.create_table(
        "event",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column(
            "kind",
            sa.Text(),
            nullable=False,
            comment="change, start, reset, reload, pause, resume, dropped, storage, ...",
        ),
        sa.Column(
            "name", sa.Text(), nullable=True, comment="the signal that changed, where one did"
        ),
        sa.Column("data", sa.Text(), nullable=True, comment="JSON object"),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_event_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_event_run_id_sim_time_s"), "event", ["run_id", "sim_time_s"], unique=False
    )
    op.create_table(
        "image",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("kind", sa.Text(), nullable=False, comment="camera or screenshot"),
        sa.Column("device", sa.Text(), nullable=True, comment="name of the camera"),
        sa.Column("path", sa.Text(), nullable=False, comment="relative to the data folder"),
        sa.Column("width", sa.Integer(), nullable=False, comment="pixels"),
        sa.Column("height", sa.Integer(), nullable=False, comment="pixels"),
        sa.Column("bytes", sa.Integer(), nullable=False, comment="size of the file"),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_image_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_image_run_id_sim_time_s"), "image", ["run_id", "sim_time_s"], unique=False
    )
    op.create_table(
        "log",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("level", sa.Text(), nullable=False, comment="debug, info, ... critical"),
        sa.Column("source", sa.Text(), nullable=False, comment="controller or bridge"),
        sa.Column("message", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_log_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_log_run_id_sim_time_s"), "log", ["run_id", "sim_time_s"], unique=False)
    op.create_table(
        "state",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("data", sa.Text(), nullable=False, comment="JSON object"),
        sa.Column(
            "odd",
            sa.Text(),
            nullable=True,
            comment="JSON object: path of a replaced value to what it was (nan, inf, ...)",
        ),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_state_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_state_run_id_sim_time_s"), "state", ["run_id", "sim_time_s"], unique=False
    )


def downgrade() -> None:
    for table in TABLES:
        op.drop_table(table)
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 0")
