"""`./run`, the way in from a checkout: what is chosen for it is used, or named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

CHECKOUT = Path(__file__).parent.parent
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell script")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the script, where nothing is set up."""
    shutil.copy(CHECKOUT / "run", tmp_path)
    return tmp_path


def refused(checkout: Path, python: str) -> str:
    """What it says to a Python that it cannot use; nothing was installed or made."""
    line, environment = [checkout / "run", "shell"], {**os.environ, "PYTHON": python}
    ended = subprocess.run(line, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stdout == ""
    assert ended.stderr.startswith(f"run: PYTHON={python}"), ended.stderr
    assert ended.stderr.count("\n") == 1
    return ended.stderr


def write_python(file: Path, version: str) -> str:
    """A program that says that it is that Python."""
    too_old = int(version < "3.10")
    write_program(file, f"case $2 in *ensurepip*) exit {too_old};; esac\necho {version}")
    return str(file)


def write_program(file: Path, lines: str) -> Path:
    """A program of the shell."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{lines}\n")
    file.chmod(0o755)
    return file


def test_a_python_that_is_not_there_is_named(checkout: Path) -> None:
    assert "no such program" in refused(checkout, "/typo")
    assert list(checkout.iterdir()) == [checkout / "run"]


def test_a_python_that_is_too_old_is_named(checkout: Path, tmp_path: Path) -> None:
    old = write_python(tmp_path / "with space" / "python", "3.09")
    assert "no Python 3.10 or newer" in refused(checkout, old)


def test_a_python_that_did_not_make_the_environment_is_named(
    checkout: Path, tmp_path: Path
) -> None:
    write_python(checkout / ".venv" / "bin" / "python", "3.11")
    other = write_python(tmp_path / "python", "3.12")
    said = refused(checkout, other)
    assert "Python 3.12" in said
    assert ".venv was made by 3.11" in said


def test_what_another_job_installed_is_not_installed_again(checkout: Path) -> None:
    python = write_python(checkout / ".venv" / "bin" / "python", "3.11")
    (checkout / "pyproject.toml").touch()

    def said(job: str) -> str:
        line, environment = [checkout / "run", job], {**os.environ, "PYTHON": python}
        return subprocess.run(line, env=environment, capture_output=True, text=True).stderr

    assert [bool(said(job)) for job in ("shell", "docs", "docs", "shell")] == [
        True, True, False, False
    ]  # fmt: skip


def test_the_tests_run_side_by_side_unless_pytest_is_told_what_to_do(
    checkout: Path, tmp_path: Path
) -> None:
    python = checkout / ".venv" / "bin" / "python"
    write_program(python, '[ "$2" != pytest ] || echo "$@"')
    (checkout / "pyproject.toml").touch()
    for program in ("chromium", "initdb"):  # else they would be installed
        write_program(tmp_path / "bin" / program, "")
    path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PYTHON": str(python), "PATH": path}

    def asked(*options: str) -> str:
        line = [checkout / "run", "tests", *options]
        return subprocess.run(line, env=environment, capture_output=True, text=True).stdout

    assert asked().split()[:3] == ["-m", "pytest", "-n"]
    assert asked("--pdb", "tests/signals") == "-m pytest --pdb tests/signals\n"
    assert asked("--no-install", "--fast").split()[2] == "--fast"


@pytest.fixture
def bare(checkout: Path, tmp_path: Path) -> Callable[..., list[str]]:
    """Run the tests where no Chromium is; return what it says, and what is done, line by line."""
    python = checkout / ".venv" / "bin" / "python"
    write_program(python, '[ "$2" != pytest ] || echo "> pytest"')
    (checkout / "pyproject.toml").touch()
    programs = tmp_path / "bin"
    write_program(programs / "initdb", "")
    write_program(programs / "id", "echo ${USER_ID:-0}")
    says = "echo Need to get 99 MB of archives."
    write_program(programs / "apt-get", f'case $* in *assume-no*) {says};; *) echo "> $*";; esac')
    for name in ("sh", "cat", "cksum", "dirname", "sed"):
        (programs / name).symlink_to(str(shutil.which(name)))

    def run(*options: str, **environment: str) -> list[str]:
        line = [checkout / "run", "tests", *options]
        environment |= {"PYTHON": str(python), "PATH": str(programs)}
        pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        ended = subprocess.run(line, env=environment, stdin=subprocess.DEVNULL, check=True, **pipes)
        return [each for each in ended.stdout.splitlines() if "into .venv" not in each]

    return run


def test_before_a_browser_is_installed_its_name_use_and_size_are_said(
    bare: Callable[..., list[str]],
) -> None:
    install = "> install -y -qq -o Dpkg::Options::=--force-confold chromium"
    assert bare() == [
        "run: Chromium is missing: the tests of the live page need it",
        "> update -qq",
        "run: apt-get install chromium",
        "run:   Need to get 99 MB of archives.",
        "run: to skip those tests instead: ./run tests --no-install",
        install,
        "> pytest",
    ]


@pytest.mark.parametrize(
    ("options", "user", "said"),
    [
        (["--no-install"], "0", "nothing is installed (--no-install)"),
        ([], "1000", "install what is missing"),
    ],
)
def test_nothing_is_installed_where_it_is_declined_or_not_allowed(
    bare: Callable[..., list[str]], options: list[str], user: str, said: str
) -> None:
    first, second, *done = bare(*options, USER_ID=user)
    assert "Chromium" in first and said in second
    assert done == ["> pytest"]
