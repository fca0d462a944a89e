"""All tables, as `webots_mcp/store/models.py` has them, and the views of the SQL file beside this.

The number of a migration is the `PRAGMA user_version` that it brings. Before one comes after this,
write out here what the models say today.

Revision ID: 0011
Revises:
"""

from pathlib import Path

from alembic import op
from sqlmodel import SQLModel

from webots_mcp.contract import APPLICATION_ID
from webots_mcp.store import models

assert models.RobotTable  # importing the models filled the metadata

revision = "0011"
down_revision = None

VIEWS = Path(__file__).with_name("0011_views.sql")


def upgrade() -> None:
    for table in SQLModel.metadata.tables.values():
        op.get_context().impl.create_table(table)
    for view in VIEWS.read_text("utf-8").split(";\n"):
        op.get_bind().exec_driver_sql(view)
    op.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    op.execute(f"PRAGMA user_version = {int(revision)}")
