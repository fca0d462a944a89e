"""Identity: UUIDs of recording, sessions and runs; what else tells one process from another.
And the newest rollups in a table of their own, which is written in a millisecond.

And the limits of what is kept, which belong to the database.

Revision ID: 0004
Revises: 0003
"""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

UUID = "random (version 4); names the row among those of all machines"
# Columns that are added leave the rows where they are: rebuilding `session` or `run` would delete
# what refers to them.
COLUMNS = {
    "session": (
        sa.Column("uuid", sa.Text(), comment=UUID),
        sa.Column(
            "process",
            sa.Text(),
            comment="which process of that pid; null where the system does not tell",
        ),
        sa.Column(
            "last_seen_monotonic_s",
            sa.Float(),
            comment="the host's monotonic clock at last_seen_wall_time_s",
        ),
        sa.Column("extern", sa.Integer(), comment="1 where nobody starts the controller again"),
        sa.Column(
            "hold_mode", sa.Text(), comment="simulation mode to go back to when the hold ends"
        ),
        sa.Column(
            "adopted_rows",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="number of the last entry taken in from its file beside",
        ),
    ),
    "run": (
        sa.Column("uuid", sa.Text(), comment=UUID),
        sa.Column(
            "rolled_state_id",
            sa.Integer(),
            server_default=sa.text("0"),
            nullable=False,
            comment="last state.id in the rollups, where beyond the watermark",
        ),
    ),
    "log": (
        sa.Column("logger", sa.Text(), comment="name of the Python logger, where one logged it"),
    ),
}
KINDS = "state, rollup, log, event, image or run"
TIMES = "run only: what is left of one stays so many times longer than its states; 0 for ever"
NAMED = ("session", "run")
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
ROLLUP = ", ".join(["run_id", "signal_id", "bucket", *COUNTS, *NUMBERS])
ALL_ROLLUP = f"""
CREATE VIEW all_rollup AS
/* Rollups, those of buckets that are over and the newest. */
SELECT {ROLLUP} FROM rollup
UNION ALL SELECT {ROLLUP} FROM recent_rollup"""
# A value held from the run's first row on: the run itself begins earlier, with its controller.
RUN_START = "v.started_sim_time_s"
FIRST_ROW = (
    "coalesce((SELECT min(f.sim_time_s) FROM state f WHERE f.run_id = v.id "
    "AND f.sim_time_s <= e.sim_time_s AND v.purged_rows = 0), v.started_sim_time_s /* purged */)"
)
LOGGER = ("l.source, l.message", "l.source, l.logger, l.message")
NEW_UUID = {
    "sqlite": "lower(hex(randomblob(4)) || '-' || hex(randomblob(2)) || '-4' || "
    "substr(hex(randomblob(2)), 2) || '-' || substr('89ab', 1 + (random() & 3), 1) || "
    "substr(hex(randomblob(2)), 2) || '-' || hex(randomblob(6)))",
    "postgresql": "gen_random_uuid()::text",
}
NOW_S = "(julianday('now') - 2440587.5) * 86400.0"


def upgrade() -> None:
    dialect = op.get_context().dialect.name
    op.create_table(
        "recording",
        sa.Column("uuid", sa.Text(), nullable=False, comment=UUID),
        sa.Column("created_wall_time_s", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("uuid"),
    )
    if dialect == "sqlite":  # PostgreSQL holds many recordings, each of which has one already
        op.execute(
            f"INSERT INTO recording (uuid, created_wall_time_s) SELECT {NEW_UUID[dialect]}, "
            f"coalesce(min(started_wall_time_s), {NOW_S}) FROM session"
        )
    op.create_table(
        "retention_limit",
        sa.Column("kind", sa.Text(), nullable=False, comment=KINDS),
        sa.Column("size_bytes", sa.BigInteger(), comment="on the disk; of pictures their files"),
        sa.Column("rows", sa.BigInteger()),
        sa.Column("age_s", sa.Float(), comment="since it was recorded, in wall time"),
        sa.Column("times", sa.Float(), comment=TIMES),
        sa.Column("set_by", sa.Text(), nullable=False, comment="serve, prune or retain"),
        sa.Column("set_wall_time_s", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("kind"),
    )
    for table, columns in COLUMNS.items():
        for column in columns:
            op.add_column(table, column)
    for table in NAMED:
        op.execute(f"UPDATE {table} SET uuid = {NEW_UUID[dialect]}")
        op.create_index(op.f(f"ix_{table}_uuid"), table, ["uuid"], unique=True)
    op.create_index(op.f("ix_command_session_id"), "command", ["session_id"])
    create_recent_rollup()
    op.execute(ALL_ROLLUP)
    if dialect == "sqlite":
        replace_in_view("robot_period", RUN_START, FIRST_ROW)
        replace_in_view("robot_log", *LOGGER)
        op.execute("PRAGMA user_version = 4")


def replace_in_view(view: str, old: str, new: str) -> None:
    """Make a view again with another text in its place."""
    connection = op.get_bind()
    found = f"SELECT sql FROM sqlite_master WHERE type = 'view' AND name = '{view}'"
    sql: str = connection.exec_driver_sql(found).scalar_one()
    connection.exec_driver_sql(f"DROP VIEW {view}")
    connection.exec_driver_sql(sql.replace(old, new))


def create_recent_rollup() -> None:
    zero = sa.text("0")
    op.create_table(
        "recent_rollup",
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("bucket", sa.Integer(), nullable=False, comment="floor(sim_time_s / 10)"),
        sa.Column(
            "signal_id", sa.Integer(), nullable=False, comment="signal.id, of the run's robot"
        ),
        *(
            sa.Column(name, sa.Integer(), server_default=zero, nullable=False, comment=comment)
            for name, comment in COUNTS.items()
        ),
        *(sa.Column(name, sa.Float(), comment=comment) for name, comment in NUMBERS.items()),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_recent_rollup_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("run_id", "bucket", "signal_id"),
        sqlite_with_rowid=False,
    )


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        replace_in_view("robot_period", FIRST_ROW, RUN_START)
        replace_in_view("robot_log", *reversed(LOGGER))
    op.execute("DROP VIEW all_rollup")
    op.execute(f"INSERT INTO rollup ({ROLLUP}) SELECT {ROLLUP} FROM recent_rollup")
    op.drop_table("recent_rollup")
    op.drop_index(op.f("ix_command_session_id"), "command")
    for table in NAMED:
        op.drop_index(op.f(f"ix_{table}_uuid"), table)
    for table, columns in COLUMNS.items():
        for column in columns:
            op.drop_column(table, column.name)
    op.drop_table("retention_limit")
    op.drop_table("recording")
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 3")
