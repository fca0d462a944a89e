"""Rollups of 500 s beside those of 10 s: a long recording is read fast as a whole.

They are made from those of 10 s while the server maintains the database, also of older recordings.

Revision ID: 0005
Revises: 0004
"""

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
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 5")


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


def downgrade() -> None:
    op.drop_table("coarse_rollup")
    op.drop_column("run", "coarse_end")
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 4")
