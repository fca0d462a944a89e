"""Databases of a real PostgreSQL: empty ones, and pools without a row."""

from __future__ import annotations

import pytest

from tests.postgres import Server
from webots_mcp.plugins.pool.postgres_schema import prepare


@pytest.fixture
def database(postgres: Server) -> str:
    """The name of an empty database."""
    return postgres.new_database()


@pytest.fixture(scope="session")
def pool_template(postgres: Server) -> str:
    """The name of a database that is a pool."""
    name = postgres.new_database()
    prepare(postgres.url(name), "the template")
    return name


@pytest.fixture
def pool(postgres: Server, pool_template: str) -> str:
    """The name of a database that is a pool without a row."""
    return postgres.new_database(pool_template)
