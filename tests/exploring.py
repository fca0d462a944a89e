"""How often tests with random input or kills try: few times in the suite, often on request.

`pytest --hypothesis-profile=explore` makes them try often, each time with other examples.
"""

from __future__ import annotations

from typing import Final

from hypothesis import settings

EXPLORES: Final = settings.default is None or not settings.default.derandomize


def attempts(usual: int, exploring: int) -> int:
    """Return how often a test is to try.

    Args:
        usual: In the suite, whose examples are the same each time.
        exploring: With `--hypothesis-profile=explore`.
    """
    return exploring if EXPLORES else usual
