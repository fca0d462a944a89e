"""The views robot_now and robot_trajectory find modes in names such as `state_name`.

Revision ID: 0009
Revises: 0008
"""

from alembic import op

revision = "0009"
down_revision = "0008"

VIEWS = ("robot_now", "robot_trajectory")
# As webots_mcp/naming.py has them; a later change there takes a migration of its own.
SPELLINGS = ("name", "label", "str")

LIKELY = "key LIKE '%status'"
WORDS = "'.' || replace(last, '_', '.')"


def without_spelling() -> str:
    """The words of a name without a last one that says only how the mode is spelled."""
    alone = ", ".join(f"'.{each}'" for each in SPELLINGS)
    shorter = f"{WORDS} || '|'"
    for each in SPELLINGS:
        shorter = f"replace({shorter}, '.{each}|', '|')"
    return f"CASE WHEN {WORDS} IN ({alone}) THEN {WORDS} ELSE rtrim({shorter}, '|') END"


def texts() -> dict[str, str]:
    """What the views had, and what takes its place."""
    spelled = "".join(f" OR key LIKE '%{each}'" for each in SPELLINGS)
    return {
        f"{LIKELY})": f"{LIKELY}{spelled})",
        f"{WORDS} AS words": f"{without_spelling()} AS words",
    }


def upgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        for view in VIEWS:
            replace_in_view(view, texts())
        op.execute("PRAGMA user_version = 9")


def replace_in_view(view: str, replaced: dict[str, str]) -> None:
    """Make a view again with other texts in their places."""
    connection = op.get_bind()
    found = f"SELECT sql FROM sqlite_master WHERE type = 'view' AND name = '{view}'"
    sql: str = connection.exec_driver_sql(found).scalar_one()
    connection.exec_driver_sql(f"DROP VIEW {view}")
    for old, new in replaced.items():
        sql = sql.replace(old, new)
    connection.exec_driver_sql(sql)


def downgrade() -> None:
    if op.get_context().dialect.name == "sqlite":
        for view in VIEWS:
            replace_in_view(view, {new: old for old, new in texts().items()})
        op.execute("PRAGMA user_version = 8")
