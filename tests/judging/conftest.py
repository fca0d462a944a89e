"""The clock for deadlines that the tests of the store have."""

from tests.store.conftest import deadlines_of_this_process

__all__ = ["deadlines_of_this_process"]
