"""The standstills of 500 s; lines of Webots' console that wait for a run.

Revision ID: 0008
Revises: 0007
"""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"

STANDSTILLS = (
    "JSON, at the signal of x: where the robot stood still, and what shows whether it should have "
    "moved; null where that was not looked for"
)
# Merged again, what older versions merged gets it as well, where no row was deleted yet.
MERGE_AGAIN = "UPDATE run SET coarse_end = NULL WHERE purged_rows = 0"


def upgrade() -> None:
    op.add_column("coarse_rollup", sa.Column("standstills", sa.Text(), comment=STANDSTILLS))
    op.execute(MERGE_AGAIN)
    create_console_line()
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 8")


def create_console_line() -> None:
    said_by = "webots, or console: a controller, not told which; as in log later on"
    op.create_table(
        "console_line",
        sa.Column("id", sa.Integer(), primary_key=True),
        sa.Column("instance", sa.Text(), nullable=False, comment="session.instance of who said it"),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("level", sa.Text(), nullable=False),
        sa.Column("source", sa.Text(), nullable=False, comment=said_by),
        sa.Column("message", sa.Text(), nullable=False),
        sa.Column("logger", sa.Text(), comment="stdout or stderr"),
        sqlite_autoincrement=True,
    )


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 7")
    op.drop_table("console_line")
    op.drop_column("coarse_rollup", "standstills")
