"""Alembic's entry: `webots_mcp.store.migrate` hands it a connection.

Offline (`alembic upgrade --sql`) it gets the name of a dialect instead.
"""

from typing import Any

from alembic import context
from alembic.ddl import base
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


@compiles(base.AddColumn, "sqlite")
def _added_with_comment(add: Any, compiler: Any, **kw: Any) -> str:
    """As above; a comment behind the last word would not be kept."""
    text = base.visit_add_column(add, compiler, **kw)  # pyright: ignore[reportUnknownMemberType]
    if not (comment := add.column.comment):
        return text
    last = "NULL" if add.column.nullable else "NOT NULL"
    return f"{text.removesuffix(' NOT NULL')} /* {comment} */ {last}"


def run(connection: Connection) -> None:
    context.configure(
        connection=connection,
        target_metadata=SQLModel.metadata,
        transactional_ddl=True,
        render_as_batch=True,
        compare_type=True,
        compare_server_default=True,
        **context.config.attributes.get("options", {}),
    )
    if adapt := context.config.attributes.get("adapt"):  # a pool's tables differ a little
        adapt(context.get_context())
    with context.begin_transaction():
        context.run_migrations()


def run_offline(dialect: str) -> None:
    context.configure(dialect_name=dialect, transactional_ddl=True)
    with context.begin_transaction():
        context.run_migrations()


if context.is_offline_mode():
    run_offline(context.config.attributes["dialect"])
else:
    run(context.config.attributes["connection"])
