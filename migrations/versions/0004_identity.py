"""Identity: UUIDs of recording, sessions and runs; what else tells one process from another.

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
            comment="rows of its spill file that were taken in",
        ),
    ),
    "run": (sa.Column("uuid", sa.Text(), comment=UUID),),
    "log": (
        sa.Column("logger", sa.Text(), comment="name of the Python logger, where one logged it"),
    ),
}
NAMED = ("session", "run")
NEW_UUID = {
    "sqlite": "lower(hex(randomblob(4)) || '-' || hex(randomblob(2)) || '-4' || "
    "substr(hex(randomblob(2)), 2) || '-' || substr('89ab', 1 + (random() & 3), 1) || "
    "substr(hex(randomblob(2)), 2) || '-' || hex(randomblob(6)))",
    "postgresql": "gen_random_uuid()::text",
}
NOW_S = {
    "sqlite": "(julianday('now') - 2440587.5) * 86400.0",
    "postgresql": "extract(epoch FROM now())",
}


def upgrade() -> None:
    dialect = op.get_context().dialect.name
    op.create_table(
        "recording",
        sa.Column("uuid", sa.Text(), nullable=False, comment=UUID),
        sa.Column("created_wall_time_s", sa.Float(), nullable=False),
        sa.PrimaryKeyConstraint("uuid"),
    )
    op.execute(
        f"INSERT INTO recording (uuid, created_wall_time_s) SELECT {NEW_UUID[dialect]}, "
        f"coalesce(min(started_wall_time_s), {NOW_S[dialect]}) FROM session"
    )
    for table, columns in COLUMNS.items():
        for column in columns:
            op.add_column(table, column)
    for table in NAMED:
        op.execute(f"UPDATE {table} SET uuid = {NEW_UUID[dialect]}")
        op.create_index(op.f(f"ix_{table}_uuid"), table, ["uuid"], unique=True)
    if dialect == "sqlite":
        op.execute("PRAGMA user_version = 4")


def downgrade() -> None:
    for table in NAMED:
        op.drop_index(op.f(f"ix_{table}_uuid"), table)
    for table, columns in COLUMNS.items():
        for column in columns:
            op.drop_column(table, column.name)
    op.drop_table("recording")
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 3")
