"""The project and the plans of the tests of trials."""

from tests.steering.trials.conftest import plan, project, refused, run

__all__ = ["plan", "project", "refused", "run"]
