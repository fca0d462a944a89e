"""Where the recording lies."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests import unprivileged
from tests.setup.doctor.conftest import found
from webots_mcp.setup.doctor.machine_checks import Mount, judge_file_system

LOCAL = Mount("/", "ext4")


def test_a_folder_that_is_not_there_yet_says_how_it_comes(tmp_path: Path) -> None:
    folder = found(tmp_path / "mcp_data" / "webots.db", "Data folder")
    assert folder.verdict == "warning"
    assert "not there yet" in folder.seen
    assert "MCPBridge" in (folder.fix or "")


def test_a_folder_that_is_a_file_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "notes").touch()
    assert found(tmp_path / "notes" / "webots.db", "Data folder").verdict == "wrong"


@pytest.mark.slow
@pytest.mark.skipif(not unprivileged.POSSIBLE, reason="permissions do not stop this user here")
def test_a_folder_that_cannot_be_written_is_wrong(bridge_recording: Path, tmp_path: Path) -> None:
    folder = tmp_path / "artifact"
    folder.mkdir()
    (folder / "webots.db").write_bytes(bridge_recording.read_bytes())
    options = ("--no-server", "--json", "--data-dir", str(folder))
    with unprivileged.unwritable(folder):
        line = unprivileged.line("-m", "webots_mcp", "doctor", *options)
        ended = subprocess.run(line, capture_output=True, text=True, check=False)
    checks = {each["check"]: each for each in json.loads(ended.stdout)["checks"]}
    assert ended.returncode == 1
    assert checks["Data folder"]["verdict"] == "wrong"
    assert "cannot be written" in checks["Data folder"]["seen"]
    assert checks["Rows"]["verdict"] == "ok"  # it is read nevertheless
    assert checks["Database"]["verdict"] == "ok"  # it has a write-ahead log where it can be written


@pytest.mark.parametrize(
    ("folder", "mounts", "in_wsl", "why"),
    [
        ("/home/ada/net/mcp_data", [LOCAL, Mount("/home/ada/net", "nfs4")], False, "network drive"),
        ("/mnt/share", [LOCAL, Mount("/mnt/share", "cifs")], False, "network drive"),
        ("/Volumes/lab/p", [Mount("/", "apfs"), Mount("/Volumes/lab", "smbfs")], False, "network"),
        ("Z:\\project", [Mount("C:\\", "NTFS"), Mount("Z:\\", "NTFS", True)], False, "network"),
        ("\\\\server\\share\\p", [Mount("C:\\", "NTFS")], False, "network drive"),
        ("\\\\wsl.localhost\\Debian\\home", [Mount("C:\\", "NTFS")], False, "a folder of WSL"),
        ("\\\\wsl$\\Debian\\home", [Mount("C:\\", "NTFS")], False, "a folder of WSL"),
        ("/mnt/c/p", [LOCAL, Mount("/mnt/c", "9p")], True, "a drive of Windows, seen from WSL"),
        ("/mnt/c/p", [LOCAL, Mount("/mnt/c", "drvfs")], True, "a drive of Windows, seen from WSL"),
    ],
)
def test_where_memory_cannot_be_shared_it_is_wrong_and_says_why(
    folder: str, mounts: list[Mount], in_wsl: bool, why: str
) -> None:
    place = judge_file_system(folder, mounts, in_wsl=in_wsl)
    assert place.verdict == "wrong"
    assert why in place.seen
    assert "--data-dir" in (place.fix or "")


@pytest.mark.parametrize(
    ("folder", "mounts", "verdict"),
    [
        ("/home/ada/p", [LOCAL, Mount("/home/ada/net", "nfs4")], "ok"),
        ("/mnt/shared", [LOCAL, Mount("/mnt/share", "nfs")], "ok"),
        ("c:\\p", [Mount("C:\\", "NTFS"), Mount("Z:\\", "NTFS", True)], "ok"),
        ("/home/ada", [LOCAL], "ok"),
        ("/media/host", [LOCAL, Mount("/media/host", "vboxsf")], "warning"),
        ("/host", [LOCAL, Mount("/host", "9p")], "warning"),
        ("/p", [], "not checked"),
    ],
)
def test_other_places_are_not_called_wrong(folder: str, mounts: list[Mount], verdict: str) -> None:
    assert judge_file_system(folder, mounts, in_wsl=False).verdict == verdict
