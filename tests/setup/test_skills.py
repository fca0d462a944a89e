"""Skills are in the form that clients read, can be followed, and leave to users what is theirs."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, Final

import pytest
from mcp import Client, StdioServerParameters

import webots_mcp
from tests.waiting import wait_for
from webots_mcp import __version__
from webots_mcp.answers.shortening import tokens_in
from webots_mcp.contract import bundled
from webots_mcp.questions import all_questions
from webots_mcp.setup.client_entries import is_ours
from webots_mcp.setup.file_change import apply
from webots_mcp.setup.skills import PLUGIN, ManagedText, managed_texts, skill_files

pytestmark = pytest.mark.anyio
CHECKOUT: Final = Path(__file__).parents[2]
BLOCK: Final = re.compile(
    r"(?:^`([\w./-]+)`[^\n]*:\n\n)?```(\w+)\n(.*?)```", re.DOTALL | re.MULTILINE
)
ROVER: Final = Path("controllers", "rover", "rover.py")
SPEED: Final = '"speed", 5.0'
# The rover publishes a signal that no name and no value explains.
PUBLISHED: Final = '            "mode": self.mode,\n'
UNEXPLAINED: Final = '            "q7": 0.3 * self.distances_m[0] ** 2 - 0.2,\n'
KNOWN: Final = ("webots_describe_signals(signals=['wheel_radps.*']", '"declared"')
UNKNOWN: Final = (
    ("webots_check_run(", '"signals understood","not judged"', "q7"),
    ("webots_describe_signals()", '["q7",', '"unknown"'),
)
# What was done before, and what the answer to each of the skill's calls then holds.
STORIES: Final[dict[str, tuple[dict[str, Any], tuple[tuple[str, ...], ...]]]] = {
    "webots-why-it-does-not-move": (
        {"for_s": 8, "parameters": {"speed": 0.0}},
        (
            *UNKNOWN, KNOWN,
            ("webots_get_robot_state(", '"status":"paused"'),
            ("webots_diagnose_setup(", '"check":"Simulation"', "rover: paused"),
            ("webots_find_events(", '"standstill"', '"why_not_stuck"', '"verdicts"'),
            ("webots_get_parameters(", '"set_by"', '"since_s"', '"command"'),
            ("webots_get_trends(", '"start_s":2.0', '"end_s":6.0'),
            ("webots_get_logs(", '"lines"'),
            ("webots_plot(", "Path from above", "end ("),
            ("webots_run(", '"stopped":"condition held"'),
        ),
    ),
    "webots-when-it-went-wrong": (
        {"for_s": 12},
        (
            *UNKNOWN, KNOWN,
            ("webots_list_runs(", '"ended_by"', '"duration_s"'),
            ("webots_find_events(run_id=1)", '"verdicts"'),
            ("webots_find_events(run_id=1, where=", '"condition"'),
            ("webots_list_signals(", "lidar.nearest_m"),
            ("webots_find_events(run_id=1, start_s=2", '"change"'),
            ("webots_query_history(", "pose.x"),
            ("webots_plot(", "lidar.nearest_m", "wheel_radps.left"),
            ("webots_run(", '"run_id":2'),
            ("webots_compare_runs(", '"verdict":"unlike from'),
            ("webots_breakpoint(", '"breakpoint_id"'),
        ),
    ),
    "webots-tune-a-parameter": (
        {"for_s": 1},
        (
            *UNKNOWN, KNOWN,
            ("webots_get_parameters(", '"speed"', '"low"'),
            ("webots_run_trials(parameters={'speed': [2.0", '"verdict"', '"trial_set":1'),
            ("webots_run_trials(trial_set=2)", '"is_best_confirmed":true', '"verdict"'),
            ("webots_plot(", "trial set 2, 8 trials"),
            ("webots-mcp trials", "8"),
            ("webots_set_parameters(", '"action":"set_parameters"', '"outcome":"done"'),
        ),
    ),
    "webots-did-my-edit-help": (
        {"for_s": 1},
        (
            *UNKNOWN, KNOWN,
            ("webots-mcp repeatability", "run_ids [2, 3, 4, 5]"),
            ("webots-mcp repeatability", "run_ids [7, 8, 9, 10]"),
            ("webots_simulation_control(", '"outcome":"done"'),
            ("webots_list_runs(", "repeat 1 of 4, by reset"),
            ("webots_compare_runs(", '"runs_wanted"', "2, 3, 4, 5", "7, 8, 9, 10"),
            ("webots_plot(", "run 5", "run 10"),
            ("webots_check_run(run_id=10)", '"run_id":10'),
            ("webots-mcp annotate", "after the edit"),
        ),
    ),
    "webots-test-a-behaviour": (
        {"for_s": 12},
        (
            *UNKNOWN,
            ("webots_list_signals(", "lidar.nearest_m"),
            ("webots_get_trends(", "mode"),
            ("pytest", "1 passed"),
            ("webots_check_run(expect=", "lidar.nearest_m > 0.1 during"),
            ("webots-mcp check", "lidar.nearest_m > 0.1"),
        ),
    ),
    "webots-new-world": (
        {},
        (
            ("webots-mcp init", ".mcp.json"),
            ("webots_run(", '"outcome":"done"'),
            ("webots_check_run(", '"signals understood","not judged"', "unknown meaning: u;"),
            ("webots_describe_signals()", '["u",', '"unknown"'),
            ("webots_describe_signals(signals=['u']", '"declared"'),
            ("webots_plot(", "Path from above"),
        ),
    ),
}  # fmt: skip


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name in ("worlds", "controllers"):
        shutil.copytree(bundled("examples") / name, tmp_path / "project" / name)
    source = tmp_path / "project" / ROVER
    text = source.read_text("utf-8")
    assert text.count(PUBLISHED) == 1
    source.write_text(text.replace(PUBLISHED, PUBLISHED + UNEXPLAINED), "utf-8")
    return tmp_path / "project"


def typed(line: str) -> list[str]:
    program, *words = shlex.split(line)
    return [sys.executable, "-m", {"webots-mcp": "webots_mcp"}.get(program, program), *words]


def environment(project: Path) -> dict[str, str]:
    above = str(Path(webots_mcp.__file__).parents[1])
    return {**os.environ, "HOME": str(project), "PYTHONPATH": above, "PYTHONIOENCODING": "utf-8"}


class Followed:
    """A client that does what a skill says, in a project."""

    def __init__(self, project: Path) -> None:
        self.project = project
        self.answers = list[tuple[str, str]]()  # what was asked, and the answer
        self.launched = list[subprocess.Popen[bytes]]()

    @asynccontextmanager
    async def connected(self) -> AsyncGenerator[Client]:
        server = StdioServerParameters(
            command=sys.executable, args=["-m", "webots_mcp", "serve"], cwd=self.project,
            env=environment(self.project),
        )  # fmt: skip
        async with Client(server) as client:
            yield client

    async def follow(self, page: str, client: Client) -> None:
        for file, language, text in BLOCK.findall(page):
            if file:
                (self.project / file).parent.mkdir(parents=True, exist_ok=True)
                (self.project / file).write_text(text, "utf-8")
            elif language == "python":
                for statement in ast.parse(text).body:
                    await self.call(client, *call_of(statement))
            else:
                for line in text.splitlines():
                    self.type(line)

    async def call(self, client: Client, tool: str, arguments: dict[str, Any]) -> None:
        if arguments.get("command") == "reload":  # the step before it says: edit the controller
            source = self.project / ROVER
            source.write_text(source.read_text("utf-8").replace(SPEED, '"speed", 9.0'), "utf-8")
        result = await client.call_tool(tool, arguments)
        texts = [each.text for each in result.content if each.type == "text"]
        asked = f"{tool}({', '.join(f'{name}={value!r}' for name, value in arguments.items())})"
        assert not result.is_error, (asked, texts)
        answer = json.dumps(result.structured_content or texts, separators=(",", ":"))
        self.answers.append((asked, answer))

    def type(self, line: str) -> None:
        if " launch " in line:
            return self.launch(line)
        ended = subprocess.run(
            typed(line), cwd=self.project, env=environment(self.project), text=True, check=False,
            capture_output=True, stdin=subprocess.DEVNULL, encoding="utf-8",
        )  # fmt: skip
        judged = (0, 1) if line.startswith("webots-mcp check") else (0,)
        assert ended.returncode in judged, (line, ended.stdout, ended.stderr)
        self.answers.append((line, ended.stdout))

    def require(self, asked: str, *facts: str) -> None:
        """One answer to what begins so holds all of these."""
        answers = [answer for question, answer in self.answers if question.startswith(asked)]
        assert any(all(fact in answer for fact in facts) for answer in answers), (facts, answers)

    def launch(self, line: str) -> None:
        log = self.project / "launch.log"
        with log.open("wb") as output:
            begun = subprocess.Popen(
                typed(line), cwd=self.project, env=environment(self.project), stdout=output,
                stderr=subprocess.STDOUT,
            )  # fmt: skip
            self.launched.append(begun)
        wait_for(lambda: " records: run " in log.read_text("utf-8"))


@contextmanager
def following(project: Path) -> Generator[Followed]:
    followed = Followed(project)
    try:
        yield followed
    finally:
        for process in followed.launched:
            process.terminate()
            process.wait()


def call_of(statement: ast.stmt) -> tuple[str, dict[str, Any]]:
    assert isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call), statement
    call = statement.value
    assert isinstance(call.func, ast.Name) and not call.args
    return call.func.id, {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}


@pytest.mark.slow
@pytest.mark.parametrize("page", skill_files(), ids=lambda page: page.parent.name)
async def test_each_skill_can_be_followed_to_the_letter(page: Path, project: Path) -> None:
    before, facts = STORIES[page.parent.name]
    parts = page.read_text("utf-8").split("restart it now")  # with a new server
    with following(project) as followed:
        if "new-world" in page.parent.name:
            shutil.rmtree(project / "worlds")
            shutil.rmtree(project / "controllers")
        else:
            followed.launch("webots-mcp launch worlds/arena.wbt --stand-in")
        for part in parts:
            async with followed.connected() as client:
                if before:
                    await followed.call(client, "webots_run", before)
                await followed.follow(part, client)
        for fact in facts:
            followed.require(*fact)


@pytest.mark.parametrize("page", skill_files(), ids=lambda page: page.parent.name)
def test_a_skill_calls_listed_tools_only_and_first_declares_what_is_unknown(page: Path) -> None:
    text = page.read_text("utf-8")
    listed = {each.name for each in all_questions() if each.tier != "all"}
    named = set(re.findall(r"\bwebots_\w+", text)) - {"webots_mcp", "webots_simulation"}
    assert len(listed) == 34 and named <= listed
    calls = [
        ast.unparse(statement)
        for file, language, block in BLOCK.findall(text)
        if language == "python" and not file
        for statement in ast.parse(block).body
    ]
    first = [call for call in calls if not call.startswith(("webots_list_runs", "webots_run"))][:2]
    assert first[0].startswith("webots_check_run(") and first[1] == "webots_describe_signals()"
    # A call outside of a block is one that the test above does not make.
    assert not re.search(r"\bwebots_\w+\(", BLOCK.sub("", text).replace("webots_simulation(", ""))


@pytest.mark.parametrize("page", skill_files(), ids=lambda page: page.parent.name)
def test_a_skill_is_a_page_with_a_head_that_clients_read(page: Path) -> None:
    text = page.read_text("utf-8")
    head = re.match(r"---\nname: ([a-z-]{1,64})\ndescription: ([^\n]{50,1024})\n---\n# ", text)
    assert head and head[1] == page.parent.name and ". Use it for " in head[2]
    assert len(text.splitlines()) <= 100 and tokens_in(text) < 1_500
    assert all(len(line) <= 130 for line in text.splitlines()[4:] if "https:" not in line)


def test_the_plugin_starts_our_server_and_has_the_version_of_the_package() -> None:
    plugin = json.loads((PLUGIN / ".claude-plugin" / "plugin.json").read_text("utf-8"))
    assert (plugin["name"], plugin["version"]) == ("webots", __version__)
    assert is_ours(plugin["mcpServers"]["webots"])
    market = CHECKOUT / ".claude-plugin" / "marketplace.json"
    (entry,) = json.loads(market.read_text("utf-8"))["plugins"]
    assert entry["name"] == plugin["name"]
    assert (CHECKOUT / entry["source"] / ".claude-plugin" / "plugin.json").is_file()
    assert len(skill_files()) == len(STORIES)


def update(project: Path) -> dict[str, str | None]:
    """What `init --skills` does; the notes by file."""
    notes = dict[str, str | None]()
    for part in managed_texts(project):
        change, note = part.plan()
        notes[part.file.relative_to(project).as_posix()] = note
        if change.is_needed:
            apply(change)
    return notes


def newer(part: ManagedText) -> ManagedText:
    return part._replace(text=f"{part.text}One more line.\n")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_newer_version_replaces_what_is_unchanged_and_keeps_what_is_not(
    tmp_path: Path, end: str
) -> None:
    agents = tmp_path / "AGENTS.md"
    agents.write_text(f"# Mine{end}Do as I say.{end}", "utf-8", newline="")
    assert set(update(tmp_path).values()) == {None}
    parts = list(managed_texts(tmp_path))
    for part in parts:  # as Git may write it on Windows
        text = part.file.read_text("utf-8")
        part.file.write_text(text, "utf-8", newline=end)
        assert not part.plan()[0].is_needed
        after = newer(part).plan()[0].after.decode()
        assert f"One more line.{end}" in after
        assert after.count("\r\n") == (after.count("\n") if end == "\r\n" else 0)
    mine = agents.read_text("utf-8")
    assert mine.startswith("# Mine\nDo as I say.\n\n<!-- webots-mcp")
    agents.write_text(f"{mine}\nMine too.\n", "utf-8")
    assert newer(parts[-1]).plan()[0].after.decode().endswith("\nMine too.\n")

    for part in parts:
        changed = part.file.read_text("utf-8").replace("Webots", "WEBOTS", 1)
        part.file.write_text(changed, "utf-8")
        change, note = newer(part).plan()
        assert not change.is_needed and note and "as you wrote or changed it" in note
    parts[0].file.write_text("mine alone\n", "utf-8")
    assert not parts[0].plan()[0].is_needed
    agents.write_bytes(b"# Mine\r\nwith both\nends")
    assert parts[-1].plan()[0].after.startswith(b"# Mine\r\nwith both\nends\r\n\r\n<!-- webots-mcp")


@pytest.mark.slow
def test_init_adds_skills_on_request_and_says_what_it_kept(project: Path) -> None:
    def init(*options: str) -> tuple[int, dict[str, Any]]:
        ended = subprocess.run(
            [*typed("webots-mcp init --json"), *options], cwd=project, env=environment(project),
            capture_output=True, check=False,
        )  # fmt: skip
        return ended.returncode, json.loads(ended.stdout.splitlines()[0])

    assert init()[0] == 0 and not (project / "AGENTS.md").exists()
    assert init("--skills", "--dry-run")[0] == 0 and not (project / ".claude").exists()
    code, said = init("--skills")
    assert code == 0 and [e["outcome"] for e in said["files"]].count("written") == 7
    (project / "AGENTS.md").write_bytes(b"\xff")
    (project / ".claude/skills/webots-new-world/SKILL.md").write_text("mine", "utf-8")
    code, said = init("--skills")
    last = {Path(each["file"]).parts[-2:][0]: each for each in said["files"][-7:]}
    assert code == 2 and said["files"][-1]["outcome"] == "refused"
    assert "remove the file" in last["webots-new-world"]["note"]
    assert (project / "AGENTS.md").read_bytes() == b"\xff"
