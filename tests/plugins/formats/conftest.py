"""The recordings in memory of the tests of export."""

from tests.store.export.conftest import recorded, recorder

__all__ = ["recorded", "recorder"]
