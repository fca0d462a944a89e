"""History: the signals of a robot, their rollups and change points.

Revision ID: 0002
Revises: 0001
"""

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

TABLES = ("watermark", "change", "rollup", "signal")


def number(name: str, comment: str | None = None) -> "sa.Column[Any]":
    return sa.Column(name, sa.Float(), nullable=True, comment=comment)


def count(name: str, comment: str) -> "sa.Column[Any]":
    default = sa.text("0")
    return sa.Column(name, sa.Integer(), server_default=default, nullable=False, comment=comment)


def upgrade() -> None:
    op.create_table(
        "signal",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("robot_id", sa.Integer(), nullable=False),
        sa.Column(
            "name",
            sa.Text(),
            nullable=False,
            comment="dotted: pose.0, sensors.front, lidar.min",
        ),
        sa.Column(
            "kind",
            sa.Text(),
            nullable=False,
            comment="num, bool, text, angle (radians), null (no value yet)",
        ),
        sa.Column("unit", sa.Text(), nullable=True, comment="where the name tells it"),
        sa.Column("path", sa.Text(), nullable=False, comment="for json_extract(state.data, path)"),
        sa.Column(
            "reduce",
            sa.Text(),
            nullable=True,
            comment="count, min, max, mean or argmin of the long array at path",
        ),
        sa.Column("first_seen_wall_time_s", sa.Float(), nullable=False),
        sa.Column("last_seen_wall_time_s", sa.Float(), nullable=False),
        count("rows", "state rows that held it, up to the watermark"),
        count("null_rows", "of them without a value"),
        count("odd_rows", "of them with a value that JSON cannot hold (nan, inf, ...)"),
        number("min"),
        number("max"),
        sa.ForeignKeyConstraint(
            ["robot_id"], ["robot.id"], name=op.f("fk_signal_robot_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("robot_id", "name", name=op.f("uq_signal_robot_id")),
        sqlite_autoincrement=True,
    )
    op.create_table(
        "rollup",
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column(
            "signal_id", sa.Integer(), nullable=False, comment="signal.id, of the run's robot"
        ),
        sa.Column("bucket", sa.Integer(), nullable=False, comment="floor(sim_time_s / 10)"),
        count("rows", "state rows that held the signal"),
        count("present", "of them with a value"),
        count("changes", "of the values, those unlike the one before in the bucket"),
        number("first", "of numbers and flags (0, 1); null for text, as all that follows"),
        number("first_sim_time_s"),
        number("last"),
        number("last_sim_time_s"),
        number("min"),
        number("min_sim_time_s", "of the first such extreme"),
        number("max"),
        number("max_sim_time_s", "of the first such extreme"),
        number("sum"),
        number("squares", "sum of squared deviations from sum / count"),
        number("sines", "angles only: sum of sines"),
        number("cosines", "angles only: sum of cosines"),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_rollup_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("run_id", "signal_id", "bucket"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "change",
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column(
            "signal_id", sa.Integer(), nullable=False, comment="signal.id, of the run's robot"
        ),
        sa.Column(
            "state_id",
            sa.Integer(),
            nullable=False,
            comment="state.id of the row, which may have been deleted since",
        ),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column(
            "value",
            sa.Text(),
            nullable=True,
            comment="text (its first 200 characters), true, false or null",
        ),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_change_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("run_id", "signal_id", "state_id"),
        sqlite_with_rowid=False,
    )
    op.create_table(
        "watermark",
        sa.Column("name", sa.Text(), nullable=False, comment="rollup"),
        sa.Column("state_id", sa.Integer(), nullable=False),
        sa.PrimaryKeyConstraint("name"),
    )
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 2")


def downgrade() -> None:
    for table in TABLES:
        op.drop_table(table)
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 1")
