"""Alembic's entry: `webots_mcp.store.migrate` hands it a connection, the shell an -x database=."""

from alembic import context
from sqlalchemy import Connection
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import CreateColumn
from sqlmodel import SQLModel

from webots_mcp.store import models  # noqa: F401  (fills the metadata)


@compiles(CreateColumn, "sqlite")
def _with_comment(create, compiler, **kw):  # type: ignore[no-untyped-def]
    """SQLite keeps the text of CREATE TABLE, so `.schema` shows the comments to a person."""
    text = compiler.visit_create_column(create, **kw)
    comment = create.element.comment
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
