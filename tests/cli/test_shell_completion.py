"""What a shell completes at the Tab key."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path

import pytest

from tests.recordings.rows import Recorded
from webots_mcp.cli import main
from webots_mcp.cli.commands import COMMANDS

BASH = shutil.which("bash")
# What bash itself does at Tab: it calls the function that `complete` has named for the command.
TAB = """
source "$1"; shift
function=$(complete -p webots-mcp | sed 's/.*-F \\([^ ]*\\).*/\\1/')
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
$function
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The script for bash, written to a file as `--install` does."""
    home = tmp_path_factory.mktemp("home")
    with pytest.MonkeyPatch().context() as here:
        here.setenv("HOME", str(home))
        assert main(["completion", "bash", "--install"]) == 0
    (file,) = (home / ".local" / "share" / "bash-completion" / "completions").iterdir()
    assert f'. "{file}"' in (home / ".bashrc").read_text()
    return file


@cache
def printed(shell: str) -> str:
    """What `completion` prints for a shell: one takes seconds, so tests share it."""
    out = StringIO()
    with redirect_stdout(out):
        assert main(["completion", shell, *(["--json"] if shell == "zsh" else [])]) == 0
    return out.getvalue()


def script_of(shell: str) -> str:
    """The script for a shell, which JSON has as well."""
    return json.loads(printed(shell))["script"] if shell == "zsh" else printed(shell)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two recordings and the folder `worlds`; do not change it."""
    folder = tmp_path_factory.mktemp("project")
    (folder / "worlds").mkdir()
    for file, robot in (("webots.db", "rover"), ("other.db", "dog")):
        recording = Recorded(folder / file)
        recording.robot(robot).state(0.1, {"pose": {"x": 1.0, "y": 2.0}, "mode": "drive"})
        recording.close()
    return folder


@pytest.mark.skipif(BASH is None, reason="no bash")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ([""], set(COMMANDS)),
        (["repo"], {"report"}),
        (["report", "--over"], {"--overwrite"}),
        (["launch", "--mode", ""], {"fast", "realtime", "pause"}),
        (["launch", "wor"], {"worlds"}),
        (["status", "--data-dir", "wor"], {"worlds"}),
        (["events", "--datab"], {"--database"}),
        (["events", "--kind", "osc"], {"oscillation"}),
        (["history", "po"], {"pose.x", "pose.y"}),
        (["plot", "--run", ""], {"1"}),
        (["tail", "--robot", ""], {"rover"}),
        (["logs", "--database", "other.db", "--robot", ""], {"dog"}),
        (["check", ""], {"1"}),
    ],
)
def test_bash_completes_commands_options_choices_files_and_recorded_names(
    script: Path, project: Path, typed: list[str], offered: set[str]
) -> None:
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    ended = subprocess.run(
        [str(BASH), "--noprofile", "--norc", "-c", TAB, "bash", script, "webots-mcp", *typed],
        cwd=project, capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": programs, "WEBOTS_MCP_DATA_DIR": str(project)},
    )  # fmt: skip
    assert set(ended.stdout.split()) - {"--help", "--version"} == offered, ended.stderr


# What zsh itself does: it calls the function with the words, and `compadd` takes what it offers.
ZSH_TAB = """
compdef() { function=$1 }
compadd() { print -rl -- "${(@P)2}" }
source $1; shift
words=("$@"); CURRENT=$#
$function
"""


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        (["events", "--kind", ""], "oscillation"),
        (["history", ""], "pose.x"),
        (["plot", "--run", ""], "1"),
        (["check", ""], "1"),
        (["tail", "--robot", ""], "rover"),
        (["logs", "--database", "other.db", "--robot", ""], "dog"),
    ],
)
@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_zsh_and_fish_complete_recorded_names(
    shell: str, tmp_path: Path, project: Path, typed: list[str], offered: str
) -> None:
    program = shutil.which(shell)
    if program is None:
        pytest.skip(f"no {shell}")
    script = tmp_path / "script"
    script.write_text(script_of(shell))
    line = " ".join(["webots-mcp", *typed])
    arguments = {
        "zsh": ["-f", "-c", ZSH_TAB, "zsh", str(script), "webots-mcp", *typed],
        "fish": ["--no-config", "-c", f"source '{script}'; complete -C '{line}'"],
    }[shell]
    ended = subprocess.run(
        [program, *arguments], cwd=project, capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
             "WEBOTS_MCP_DATA_DIR": str(project)},
    )  # fmt: skip
    assert offered in ended.stdout.split(), (ended.stdout, ended.stderr)


@pytest.mark.slow
@pytest.mark.parametrize("shell", ["zsh", "fish", "powershell"])
def test_each_shell_has_a_script_that_knows_every_command(
    shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if shell == "powershell" and sys.version_info < (3, 11):
        assert main(["completion", shell]) == 2
        assert "PowerShell needs Python 3.11 or newer" in capsys.readouterr().err
        return
    script = script_of(shell)
    assert [name for name in COMMANDS if name not in script] == []


def test_a_script_comes_as_json_as_well() -> None:
    told = json.loads(printed("zsh"))
    assert told.keys() == {"shell", "script"}
    assert told["shell"] == "zsh" and told["script"].startswith("#compdef webots-mcp")
