"""`webots-mcp prove` on programs in the place of Webots: good ones, wrong ones, dead ones."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial
from getpass import getuser
from pathlib import Path
from typing import Any

import pytest

from docs import reference
from tests.simulator.webots_program import put_on_path
from webots_mcp.cli import main
from webots_mcp.contract import host_name
from webots_mcp.plugins.prove.bench import Bench, run_check
from webots_mcp.plugins.prove.fact_checks import CHECKS, NOT_TRIED, check_launch
from webots_mcp.simulator.installations import HOME_VARIABLE

posix = pytest.mark.skipif(os.name != "posix", reason="the program `webots` is a script")
DOCS = Path(__file__).parents[3] / "docs"
Prove = Callable[..., "tuple[int, dict[str, Any]]"]


def webots_in(folder: Path) -> Path:
    """Make the folder of a Webots."""
    put_on_path(folder / "webots")
    (folder / "webots/resources").mkdir()
    (folder / "webots/resources/version.txt").write_text("R2025a\n", "utf-8")
    return folder / "webots"


def proven(home: Path, *only: str, patience_s: int = 60) -> tuple[int, dict[str, Any]]:
    """Run some checks, or all; return the exit code, and what was printed for programs."""
    command = [sys.executable, "-m", "webots_mcp", "prove", "--json", "--webots", str(home)]
    command += ["--patience", str(patience_s)]
    command += [word for name in only for word in ("--only", name)]
    environment = os.environ | {"DISPLAY": ":99"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return webots_in(tmp_path)


@pytest.fixture
def prove(home: Path) -> Prove:
    return partial(proven, home)


@pytest.fixture(scope="module")
def good_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return webots_in(tmp_path_factory.mktemp("good"))


@pytest.fixture(scope="module")
def all_proven(good_home: Path) -> tuple[int, dict[str, Any]]:
    """All checks of a good Webots."""
    return proven(good_home)


def outcomes(found: dict[str, Any]) -> dict[str, str]:
    return {each["check"]: each["outcome"] for each in found["checks"]}


def seen(found: dict[str, Any], check: str) -> str:
    return next(str(each["seen"]) for each in found["checks"] if each["check"] == check)


@posix
@pytest.mark.slow
def test_a_webots_that_is_as_its_sources_say_is_as_expected_in_all(
    all_proven: tuple[int, dict[str, Any]],
) -> None:
    code, found = all_proven
    others = [each for each in found["checks"] if each["outcome"] == "otherwise"]
    assert not others, json.dumps(others, indent=1)
    assert code == 0
    assert {n for n, outcome in outcomes(found).items() if outcome == "not tried"} == {*NOT_TRIED}
    assert [*outcomes(found)] == [*CHECKS, *NOT_TRIED]


@pytest.mark.slow
@posix
def test_what_is_sent_names_the_versions_and_no_place_user_or_machine(
    all_proven: tuple[int, dict[str, Any]], good_home: Path
) -> None:
    _, found = all_proven
    assert found["counts"]["as expected"] == len(CHECKS)
    assert found["webots"] == "R2025a"
    assert {"webots_mcp", "system", "machine", "python"} <= found.keys()
    assert "rover.py" in seen(found, "hang")
    text = json.dumps(found)
    for name in (str(good_home.parent), str(Path.home()), sys.prefix, host_name(), getuser()):
        assert not re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text), name


@pytest.mark.slow
@posix
def test_a_webots_that_is_otherwise_is_told_with_what_was_seen_and_what_works_still(
    prove: Prove, home: Path
) -> None:
    program = home / "webots"
    good = program.read_text("utf-8")
    obeying_always_and_ending_with_0 = (
        "from tests.simulator import webots_program as program\nlisten = program._listen\n"
        "program._listen = lambda port, *, streams: listen(port + 1, streams=True)\n"
        "main(sys.argv[1:])\n"
    )
    program.write_text(
        good.replace("sys.exit(main(sys.argv[1:]))", obeying_always_and_ending_with_0), "utf-8"
    )
    code, found = prove("options", "no orders", "quit", "steps")
    assert code == 1
    assert outcomes(found) == {
        "options": "otherwise", "no orders": "otherwise", "quit": "otherwise",
        "steps": "as expected",
    }  # fmt: skip
    assert "paused by client" in seen(found, "no orders")
    assert seen(found, "quit") == "exit code 0, not 7"
    assert all(
        each["works still"] and each["expected"]
        for each in found["checks"]
        if each["outcome"] == "otherwise"
    )


@pytest.mark.slow
@posix
def test_a_webots_that_never_runs_a_controller_costs_one_start_and_not_one_for_each_check(
    prove: Prove, home: Path
) -> None:
    says_a_place = "#!/bin/sh\necho '/opt/somebody/webots-bin: no Qt' >&2\nexec sleep 600\n"
    (home / "webots").write_text(says_a_place, "utf-8")
    code, found = prove("launch", "options", "layout", "reload", patience_s=2)
    assert code == 1
    assert [*outcomes(found).values()] == ["otherwise", "not tried", "not tried", "not tried"]
    said = seen(found, "launch")
    assert "does not listen" in said
    assert "its console has: webots-bin: no Qt" in said
    assert "without a bridge: speaker (" in said, "an observer records"


@pytest.mark.slow
@posix
def test_a_check_that_hangs_is_given_up_and_the_next_one_has_a_webots_again(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(HOME_VARIABLE, str(home))
    monkeypatch.setenv("DISPLAY", ":99")
    bench, free, late = Bench(tmp_path / "project", patience_s=60), threading.Event(), list[str]()

    def check_stuck(bench: Bench) -> None:
        """It never ends; otherwise it would; otherwise nothing."""
        bench.patience_s = 0  # which ends with a check
        webots = bench.webots()
        free.wait()
        late.append(f"Webots ended: {webots.is_over}")
        bench.row()

    try:
        found = run_check(check_launch, bench)
        assert found["outcome"] == "as expected", found
        bench.patience_s = 1
        found = run_check(check_stuck, bench, limit_s=0.5)
        assert (found["outcome"], found["seen"]) == ("otherwise", "it hung for 0.5 s")
        stuck = bench.user
        bench.patience_s = 60
        assert run_check(check_launch, bench)["outcome"] == "as expected"
        free.set()
        stuck.join()
        assert late == ["Webots ended: True"]
    finally:
        bench.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--only", "flying"], "--only 'flying' is none of installed, "),
        (["--patience", "nan"], "'nan' is not a whole number"),
        (["--webots", "nowhere"], "nowhere is neither the folder nor the program of a Webots"),
    ],
)
def test_what_is_not_there_is_refused_before_anything_starts(
    options: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        code = main(["prove", *options])
    except SystemExit as refused:  # by the parser of the command line
        code = refused.code
    assert code == 2
    assert said in capsys.readouterr().err


def test_the_page_about_webots_lists_each_check() -> None:
    rows = re.findall(r"(?m)^\| `(.+?)` \| (.+) \| (.+) \|$", reference.proven())
    assert [name for name, *_ in rows] == [*CHECKS, *NOT_TRIED]
    assert reference.ADDED["docs/webots"]("") == reference.proven()
    assert "`webots-mcp prove`" in (DOCS / "webots.md").read_text("utf-8")


def test_each_check_says_what_is_expected_and_what_works_still() -> None:
    for name, check in CHECKS.items():
        assert (check.__doc__ or "").count("; otherwise ") == 1, name
