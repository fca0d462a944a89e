"""Alembic's entry: whoever makes tables hands it a connection."""

from typing import Any

from alembic import context
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.schema import CreateColumn


@compiles(CreateColumn, "sqlite")
def _with_comment(create: Any, compiler: Any, **kw: Any) -> str:
    """SQLite keeps the text of CREATE TABLE, so `.schema` shows the comments to a person."""
    text: str = compiler.visit_create_column(create, **kw)
    comment: str | None = create.element.comment
    return f"{text} /* {comment} */" if comment else text


attributes = context.config.attributes
context.configure(
    connection=attributes["connection"],
    transactional_ddl=True,
)
with context.begin_transaction():
    context.run_migrations()
