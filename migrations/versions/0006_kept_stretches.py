"""Stretches that are kept at full rate, and their states, which retention leaves.

And the largest step between values that follow each other, in rollups; in whose simulation the
trials of a set run, and why they stopped. The views robot_now and robot_trajectory know positions
in centimetres and millimetres.

Revision ID: 0006
Revises: 0005
"""

import json

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"

FIGURES = (
    *("rows", "present", "changes", "first", "first_sim_time_s", "last", "last_sim_time_s"),
    *("min", "min_sim_time_s", "max", "max_sim_time_s", "sum", "squares", "sines", "cosines"),
)
STEP = "largest_step"
STEP_COMMENT = (
    "largest difference of values that follow each other; null in those of older versions"
)
ROLLUPS = ("rollup", "recent_rollup")
UUID = "random (version 4); names the row among those of all machines"
# Columns that are added leave the rows where they are: rebuilding `trial_set` would delete its
# trials. Alembic adds no foreign key to a table of SQLite.
REFERENCES = {
    "robot_id": "INTEGER /* in whose simulation the trials run; null: each in one of its own */ "
    "CONSTRAINT fk_trial_set_robot_id REFERENCES robot (id) ON DELETE SET NULL",
    "session_id": "INTEGER /* of the controller that was tried */ "
    "CONSTRAINT fk_trial_set_session_id REFERENCES session (id) ON DELETE SET NULL",
}
TEXTS = {
    "former_values": "JSON object: its parameters before, until they are set back",
    "stop_reason": "why it does not go on although trials wait",
}

EVERY_STATE = """
CREATE VIEW every_state AS
/* All states of a run, those that only kept stretches have included: they have no state_id. */
SELECT id AS state_id, run_id, sim_time_s, wall_time_s, data, odd FROM state
UNION ALL
SELECT NULL, run_id, sim_time_s, wall_time_s, data, odd FROM kept_state"""

ROBOT_KEPT = """
CREATE VIEW robot_kept AS
/* Stretches that are kept at full rate: from when to when, why, how many states each has. */
SELECT r.name AS robot, k.run_id, k.id AS stretch_id, k.start_sim_time_s AS start_s,
  min(k.end_sim_time_s, max(u.last_sim_time_s, k.start_sim_time_s)) AS end_s,
  (SELECT count(*) FROM every_state s WHERE s.run_id = k.run_id
    AND s.sim_time_s BETWEEN k.start_sim_time_s AND k.end_sim_time_s) AS states,
  strftime('%Y-%m-%d %H:%M:%f', k.wall_time_s, 'unixepoch') AS utc, k.reason
FROM kept_stretch k JOIN run u ON u.id = k.run_id JOIN robot r ON r.id = u.robot_id"""

# As webots_mcp/naming.py had them; a later change there takes a migration of its own.
BRANCHES = ("pose", "position", "pos", "gps", "odometry", "odom", "location")
UNITS = {"mm": 0.001, "cm": 0.01}
LENGTHS = ("m", "cm", "mm")
NAME = """replace(replace(replace({}, '"', ''), '[', '.'), ']', '')"""


def pairs(lengths: tuple[str, ...], units_of_branches: tuple[str, ...]) -> str:
    """The usual places of x and y, as a JSON object, where names may end in these units."""
    named = [(f"x_{unit}", f"y_{unit}") for unit in lengths]
    axes = (("[0]", "[1]"), (".x", ".y"), *((f".{x}", f".{y}") for x, y in named))
    usual = [(branch + x, branch + y) for branch in BRANCHES for x, y in axes]
    usual += [
        (f"{branch}_{unit}[0]", f"{branch}_{unit}[1]")
        for branch in BRANCHES
        for unit in units_of_branches
    ]
    return json.dumps(dict([*usual, ("x", "y"), *named]))


def metres(path: str) -> str:
    """What one of the unit that stands in a path is in metres: 1 where there is none."""
    name = f"{NAME.format(path)} || '.'"
    cases = " ".join(f"WHEN {name} GLOB '*_{unit}.*' THEN {size}" for unit, size in UNITS.items())
    return f"CASE {cases} ELSE 1 END"


def positions() -> dict[str, str]:
    """The texts by which the views find a coordinate: without units and with them."""
    old, new = pairs(("m",), ()), pairs(LENGTHS, LENGTHS)
    texts: dict[str, str] = {}
    for usual, other in (("p.key", "x"), ("p.value", "y")):
        found, branch = f"(SELECT json_extract(j, '$.' || {usual})", f"(SELECT {other}.value"
        texts[f"{found} FROM json_each('{old}') p"] = (
            f"{found} * {metres('p.key')}\n      FROM json_each('{new}') p"
        )
        texts[f"{branch} FROM json_tree(j) x"] = (
            f"{branch} * {metres('x.path')}\n      FROM json_tree(j) x"
        )
    return texts


def upgrade() -> None:
    for table in (*ROLLUPS, "coarse_rollup"):
        op.add_column(table, sa.Column(STEP, sa.Float(), comment=STEP_COMMENT))
    replace_all_rollup((*FIGURES, STEP))
    for name, declared in REFERENCES.items():
        if op.get_context().dialect.name == "sqlite":
            op.execute(f"ALTER TABLE trial_set ADD COLUMN {name} {declared}")
        else:
            op.add_column("trial_set", sa.Column(name, sa.Integer()))
        op.create_index(op.f(f"ix_trial_set_{name}"), "trial_set", [name])
    for name, comment in TEXTS.items():
        op.add_column("trial_set", sa.Column(name, sa.Text(), comment=comment))
    create_kept_stretch()
    create_kept_state()
    if op.get_context().dialect.name == "sqlite":
        for created in (EVERY_STATE, ROBOT_KEPT):
            op.get_bind().exec_driver_sql(created.strip())
        for view in ("robot_now", "robot_trajectory"):
            replace_in_view(view, positions())
        op.execute("PRAGMA user_version = 6")


def replace_all_rollup(figures: tuple[str, ...]) -> None:
    """Make the view of both tables of rollups again, with these figures."""
    columns = ", ".join(["run_id", "signal_id", "bucket", *figures])
    tables = "\nUNION ALL ".join(f"SELECT {columns} FROM {table}" for table in ROLLUPS)
    said = "/* Rollups, those of buckets that are over and the newest. */"
    op.execute("DROP VIEW all_rollup")
    op.execute(f"CREATE VIEW all_rollup AS\n{said}\n{tables}")


def replace_in_view(view: str, texts: dict[str, str]) -> None:
    """Make a view again with other texts in their places."""
    connection = op.get_bind()
    found = f"SELECT sql FROM sqlite_master WHERE type = 'view' AND name = '{view}'"
    sql: str = connection.exec_driver_sql(found).scalar_one()
    connection.exec_driver_sql(f"DROP VIEW {view}")
    for old, new in texts.items():
        sql = sql.replace(old, new)
    connection.exec_driver_sql(sql)


def create_kept_stretch() -> None:
    op.create_table(
        "kept_stretch",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column("uuid", sa.Text(), nullable=False, comment=UUID),
        sa.Column("start_sim_time_s", sa.Float(), nullable=False),
        sa.Column(
            "end_sim_time_s",
            sa.Float(),
            nullable=False,
            comment="ahead of the newest row while it goes on",
        ),
        sa.Column("wall_time_s", sa.Float(), nullable=False, comment="when it was asked for"),
        sa.Column("reason", sa.Text(), nullable=False, comment="why it is kept"),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_kept_stretch_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sqlite_autoincrement=True,
    )
    op.create_index(
        op.f("ix_kept_stretch_run_id_start_sim_time_s"),
        "kept_stretch",
        ["run_id", "start_sim_time_s"],
    )
    op.create_index(op.f("ix_kept_stretch_uuid"), "kept_stretch", ["uuid"], unique=True)


def create_kept_state() -> None:
    op.create_table(
        "kept_state",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("run_id", sa.Integer(), nullable=False),
        sa.Column(
            "call",
            sa.Integer(),
            comment="its number in the session; null where retention moved it here from state",
        ),
        sa.Column("sim_time_s", sa.Float(), nullable=False),
        sa.Column("wall_time_s", sa.Float(), nullable=False),
        sa.Column("data", sa.Text(), nullable=False, comment="JSON object"),
        sa.Column("odd", sa.Text(), comment="as in state"),
        sa.ForeignKeyConstraint(
            ["run_id"], ["run.id"], name=op.f("fk_kept_state_run_id"), ondelete="CASCADE"
        ),
        sa.PrimaryKeyConstraint("id"),
        sa.UniqueConstraint("run_id", "call", name=op.f("uq_kept_state_run_id")),
        sqlite_autoincrement=True,
    )
    op.create_index(op.f("ix_kept_state_run_id_sim_time_s"), "kept_state", ["run_id", "sim_time_s"])


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        for view in ("robot_now", "robot_trajectory"):
            replace_in_view(view, {new: old for old, new in positions().items()})
        op.execute("DROP VIEW robot_kept")
        op.execute("DROP VIEW every_state")
        op.execute("PRAGMA user_version = 5")
    op.drop_table("kept_state")
    op.drop_table("kept_stretch")
    for name in REFERENCES:
        op.drop_index(op.f(f"ix_trial_set_{name}"), "trial_set")
    for name in (*REFERENCES, *TEXTS):
        op.drop_column("trial_set", name)
    replace_all_rollup(FIGURES)
    for table in (*ROLLUPS, "coarse_rollup"):
        op.drop_column(table, STEP)
