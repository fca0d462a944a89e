"""Public situations that were labelled before they were asked about earn the points they did."""

from __future__ import annotations

import pytest

from tests.cases.public import FALSE, HELPFUL, PUBLIC, RIGHT, labels, score

# What is answered wrongly or not at all today, and why.
_GAPS: dict[str, str] = {}


def test_each_public_situation_has_a_recording_a_label_and_a_source() -> None:
    assert sorted(PUBLIC) == sorted(labels())
    assert all(each["source"].startswith("https://") for each in labels().values())
    assert sum(bool(each.get("healthy")) for each in labels().values()) >= 4


def _cases(*, healthy: bool) -> list[object]:
    return [
        pytest.param(
            name,
            id=label["situation"],
            marks=pytest.mark.xfail(reason=_GAPS[name], strict=True) if name in _GAPS else (),
        )
        for name, label in labels().items()
        if bool(label.get("healthy")) is healthy
    ]


@pytest.mark.parametrize("name", _cases(healthy=True))
def test_no_alarm_is_raised_where(name: str) -> None:
    found = score(name)
    assert found.points == RIGHT, found.answered


@pytest.mark.parametrize("name", _cases(healthy=False))
def test_an_answer_helps_where(name: str) -> None:
    found = score(name)
    assert found.points >= HELPFUL > FALSE, found.answered
