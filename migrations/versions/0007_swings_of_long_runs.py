"""The swings of 500 s, beside what its rollups come to; and in all rollups how long a value rested.

Revision ID: 0007
Revises: 0006
"""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"

FIGURES = (
    *("rows", "present", "changes", "first", "first_sim_time_s", "last", "last_sim_time_s"),
    *("min", "min_sim_time_s", "max", "max_sim_time_s", "sum", "squares", "sines", "cosines"),
    "largest_step",
)
RESTS = {
    "first_until_sim_time_s": "up to then it had its first number; null in older versions",
    "last_since_sim_time_s": "from then on it had its last number; null in older versions",
}
ROLLUPS = ("rollup", "recent_rollup")
SWINGS = (
    "JSON: the swings of what a robot swings with, each as [begin, end, half swings, period in s, "
    "amplitude, explained share]; null where they were not looked for"
)


def upgrade() -> None:
    for table in (*ROLLUPS, "coarse_rollup"):
        for name, comment in RESTS.items():
            op.add_column(table, sa.Column(name, sa.Float(), comment=comment))
    op.add_column("coarse_rollup", sa.Column("swings", sa.Text(), comment=SWINGS))
    replace_all_rollup((*FIGURES, *RESTS))
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 7")


def replace_all_rollup(figures: tuple[str, ...]) -> None:
    """Make the view of both tables of rollups again, with these figures."""
    columns = ", ".join(["run_id", "signal_id", "bucket", *figures])
    tables = "\nUNION ALL ".join(f"SELECT {columns} FROM {table}" for table in ROLLUPS)
    said = "/* Rollups, those of buckets that are over and the newest. */"
    op.execute("DROP VIEW all_rollup")
    op.execute(f"CREATE VIEW all_rollup AS\n{said}\n{tables}")


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        op.execute("PRAGMA user_version = 6")
    replace_all_rollup(FIGURES)
    op.drop_column("coarse_rollup", "swings")
    for table in (*ROLLUPS, "coarse_rollup"):
        for name in RESTS:
            op.drop_column(table, name)
