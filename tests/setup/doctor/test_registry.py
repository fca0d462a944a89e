"""All checks together: on what is well, and what each of them leads to."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from tests.setup.doctor.conftest import found
from webots_mcp.setup.doctor import (
    PAGE,
    Diagnosis,
    DoctorCheck,
    Examined,
    all_checks,
    diagnose,
    subject_of,
    worst,
)
from webots_mcp.store.recording import RecordingAccess

CHECKOUT = Path(__file__).parents[3]
# What a machine without Webots, and a folder of no project and without clients, cannot have.
ELSEWHERE = {"Webots", "Clients", "Controllers", "Supervisor", "Recording now", "Free space"}


def test_each_check_has_its_part_of_the_page_and_each_part_its_check() -> None:
    headings = re.findall(
        r"^## (.+)$", (CHECKOUT / "docs" / f"{PAGE}.md").read_text("utf-8"), re.MULTILINE
    )
    assert headings == [check.name for check in all_checks(with_server=True)]
    assert all_checks()[3].page == "webots-mcp help troubleshooting data-folder"


def test_a_recording_of_a_robot_that_has_finished_is_well(bridge_recording: Path) -> None:
    subject = subject_of(RecordingAccess(bridge_recording, bridge_recording.parent), "the test")
    bad = [each for each in diagnose(subject) if not each.is_well]
    assert {each.check.name for each in bad} <= ELSEWHERE, bad
    assert "wrong" not in {each.finding.verdict for each in bad}


def test_a_check_that_fails_says_so_and_the_others_go_on(tmp_path: Path) -> None:
    def fails(_: Examined) -> Iterator[Diagnosis]:
        raise PermissionError("nobody may look there")

    subject = subject_of(RecordingAccess(tmp_path / "webots.db", tmp_path), "the test")
    well = DoctorCheck("Two", lambda _: iter(()), well="all well")
    several = DoctorCheck(
        "Three", lambda _: iter([Diagnosis("ok", "a"), Diagnosis("wrong", "b", "x")])
    )
    first, second, third = diagnose(subject, (DoctorCheck("One", fails), well, several))
    assert first.finding.verdict == "not checked"
    assert "nobody may look there" in first.finding.seen
    assert second.is_well
    assert third.finding == Diagnosis("wrong", "b", "x")


def test_of_several_findings_those_that_are_well_are_left_out() -> None:
    several = [Diagnosis("ok", "a"), Diagnosis("warning", "b", "x"), Diagnosis("wrong", "c", "x")]
    assert worst(several) == Diagnosis("wrong", "b; c", "x")
    assert worst(several[:1]) == several[0]


def test_nothing_is_made_where_nothing_is(tmp_path: Path) -> None:
    file = tmp_path / "nowhere" / "webots.db"
    for check in all_checks():
        found(file, check.name)
    assert not file.parent.exists()
