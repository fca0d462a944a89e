"""Ctrl-C between any two lines of the bridge costs no other row, no lock and no second Ctrl-C."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bridge.interrupting import Interrupter, drive, make_template, places

pytestmark = pytest.mark.slow


@pytest.mark.filterwarnings(  # Python closes the file that was just being opened, and says so
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)
def test_wherever_an_interrupt_comes_rows_are_written_once_and_nothing_stays_held(
    tmp_path: Path,
) -> None:
    template = make_template(tmp_path)
    found = places(tmp_path / "look", instructions=False)
    assert len(found) > 200
    unclean: dict[str, object] = {}
    for number, at in enumerate(found):
        outcome = drive(
            tmp_path / f"{number}", Interrupter(instructions=False, at=at, template=template)
        )
        if not outcome.is_clean:
            unclean[f"{Path(at[0][0]).name}:{at[0][1]} visit {at[1]}"] = outcome
    assert unclean == {}
