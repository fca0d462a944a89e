"""Diagnoses of what a test has broken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.contract import DATABASE_NAME
from webots_mcp.setup.doctor import Diagnosis, all_checks, diagnose, subject_of
from webots_mcp.store.recording import RecordingAccess

Look = Callable[..., Diagnosis]


def found(file: Path, check: str, *server: str) -> Diagnosis:
    """What a check says of a recording; its server may be another program."""
    (asked,) = [each for each in all_checks(with_server=True) if each.name == check]
    subject = subject_of(RecordingAccess(file, file.parent), "the test")
    subject = replace(subject, project=file.parent, server=server or subject.server)
    ((_, finding),) = diagnose(subject, (asked,))
    return finding


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / DATABASE_NAME


@pytest.fixture
def look(file: Path) -> Look:
    """Run one check on the test's recording."""
    return partial(found, file)


@pytest.fixture
def recorded(file: Path) -> Iterator[Recorded]:
    recording = Recorded(file)
    yield recording
    recording.close()
