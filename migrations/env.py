"""Alembic's entry: `webots_mcp.store.migrate` hands it a connection."""

from typing import Any

from alembic import context
from sqlalchemy import Connection
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import CreateColumn
from sqlmodel import SQLModel

from webots_mcp.store import models

assert models.Robot  # importing the models filled the metadata


@compiles(CreateColumn, "sqlite")
def _with_comment(create: Any, compiler: Any, **kw: Any) -> str:
    """SQLite keeps the text of CREATE TABLE, so `.schema` shows the comments to a person."""
    text: str = compiler.visit_create_column(create, **kw)
    comment: str | None = create.element.comment
    return f"{text} /* {comment} */" if comment else text


def run(connection: Connection) -> None:
    context.configure(
        connection=connection,
        target_metadata=SQLModel.metadata,
        transactional_ddl=True,
        render_as_batch=True,
    )
    with context.begin_transaction():
        context.run_migrations()


run(context.config.attributes["connection"])
