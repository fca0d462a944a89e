"""The bridge's lines put into controllers: where they belong, or why not; undone to the byte."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.errors import InvalidInputError
from webots_mcp.setup.project_edits import (
    IMPORT,
    AlreadyPatchedError,
    attaching_place,
    patch,
    unpatch,
)

PLAIN = """from controller import Robot

robot = Robot()
while robot.step(32) != -1:
    pass
"""
FORMS = {
    "plain": (PLAIN, "MCPBridge.attach(robot)"),
    "module": ("import controller\nr = controller.Supervisor()\n", "MCPBridge.attach(r)"),
    "alias": ("import controller as c\nr: object = c.Robot()\n", "MCPBridge.attach(r)"),
    "renamed": ("from controller import Robot as R, Motor\nr = R()\n", "MCPBridge.attach(r)"),
    "star": ("from controller import *\nr = Supervisor()\n", "MCPBridge.attach(r)"),
    "two names": ("from controller import Robot\na = b = Robot()\n", "MCPBridge.attach(a)"),
    "several lines": ("from controller import (\n  Robot,\n)\nr = Robot(\n)\n",
                      "MCPBridge.attach(r)"),
    "attribute": ("from controller import Robot\nclass C:\n  def __init__(self):\n"
                  "    self.robot = Robot()  # mine\nC()\n", "    MCPBridge.attach(self.robot)"),
    "main": ("from controller import Robot\ndef main():\n\tr = Robot()\nif __name__ == '__main__':"
             "\n\tmain()\n", "\tMCPBridge.attach(r)"),
    "guarded import": ("try:\n    from controller import Robot\nexcept ImportError:\n    raise\n"
                       "r = Robot()\n", "MCPBridge.attach(r)"),
    "subclass": ("from controller import Robot\nclass R(Robot):\n    def __init__(self):\n"
                 "        super().__init__()\n        self.a = 1\nif __name__ == '__main__':\n"
                 "    R().run()\n", "        MCPBridge.attach(self)"),
    "old super": ("from controller import Robot\nclass R(Robot):\n    def __init__(self):\n"
                  "        Robot.__init__(self)\nR()\n", "        MCPBridge.attach(self)"),
    "subclass of a subclass": (
        "from controller import Robot\nclass A(Robot):\n  def __init__(me):\n"
        "    super(A, me).__init__()\nclass B(A):\n  pass\nB().run()\n",
        "    MCPBridge.attach(me)"),
    "made elsewhere": (
        "from deepbots.supervisor import RobotSupervisorEnv\nclass Env(RobotSupervisorEnv):\n"
        "    def __init__(self, steps):\n        super().__init__()\n        self.n = steps\n",
        "        MCPBridge.attach(self)"),
    "two classes": ("from controller import Robot\nclass A(Robot):\n  def __init__(self):\n"
                    "    super().__init__()\nclass B(A):\n  def __init__(self):\n"
                    "    super().__init__()\n", "    MCPBridge.attach(self)"),
    "driver": ("from vehicle import Driver\nd = Driver()\nwhile d.step() != -1: pass\n",
               "MCPBridge.attach(d)"),
    "subclass without constructor": ("from controller import Robot\nclass R(Robot): pass\nr = R()",
                                     "MCPBridge.attach(r)"),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_the_robot_is_attached_where_it_is_made(form: str, tmp_path: Path) -> None:
    source, attach = FORMS[form]
    patched = patch(source.encode()).decode()
    assert [line for line in patched.splitlines() if line not in source.splitlines()] == [
        IMPORT, attach
    ]  # fmt: skip
    compile(patched, form, "exec")
    (tmp_path / "c.py").write_text(source)
    place = attaching_place(tmp_path / "c.py")
    assert place.statement == attach.strip()
    assert [line.strip() for line in patched.splitlines()][place.line + 1] == place.statement
    assert unpatch(patched.encode()) == source.encode()


def test_a_patched_controller_is_not_patched_again() -> None:
    with pytest.raises(AlreadyPatchedError, match="line 2"):
        patch(patch(PLAIN.encode()))


@pytest.mark.parametrize(
    ("source", "why"),
    [
        ("x = 1\n", "does not import Robot"),
        ("from controller import Robot\n", "makes no Robot"),
        ("from controller import Robot\nclass A(Robot): pass\nclass B(Robot): pass\n",
         r"several classes .*lines 2, 3"),
        ("from controller import Robot\nclass A(Robot): pass\n", r"A in line 2 has no constructor"),
        ("from controller import Robot\na = Robot()\nb = Robot()\n", r"several .*lines 2, 3"),
        ("from controller import Robot\nmain(Robot())\n", "not assigned to a name"),
        ("from controller import Robot\na[0] = Robot()\n", "no plain name"),
        ("from controller import Robot\nif 1: r = Robot()\n", "other statements"),
        ("from controller import Robot\nr = Robot(); r.step(8)\n", "other statements"),
        ("from controller import Robot\nr = Robot(); s = '''\n'''\n", "other statements"),
        ("from controller import Robot\nfor _ in x:\n  r = Robot()\n", "within a loop"),
        ("from controller import Robot\nclass Robot: pass\nr = Robot()\n", "something else"),
        ("try:\n  from controller import Robot\nexcept ImportError:\n  from fake import Robot\n"
         "r = Robot()\n", "something else"),
        ("def main():\n  from controller import Robot\n  r = Robot()\n", "at its top"),
        ("if 1:\n  from controller import Robot\n  r = Robot()\n", "inside the block of line 1"),
        ("from controller import Robot\nclass R(Robot):\n  def __init__(self): pass\nR()\n",
         "does not call super"),
        ("from controller import Robot\nMCPBridge = 1\nr = Robot()\n", "another MCPBridge"),
        ("from controller import Robot\nr = Robot(\n", "no Python that can be read"),
        ("print 'old'\n", r"\(line 1\)"),
    ],
)  # fmt: skip
def test_what_is_not_certain_is_refused_with_the_reason(source: str, why: str) -> None:
    with pytest.raises(InvalidInputError, match=why):
        patch(source.encode())


def test_what_was_not_written_so_is_not_taken_out() -> None:
    by_hand = PLAIN.replace("while", "from webots_mcp import MCPBridge\nMCPBridge(robot)\nwhile")
    for source in (PLAIN, by_hand):
        with pytest.raises(InvalidInputError, match="by hand"):
            unpatch(source.encode())


def test_later_changes_elsewhere_outlive_the_undoing() -> None:
    patched = patch(PLAIN.encode())
    assert unpatch(patched.replace(b"32", b"64")) == PLAIN.replace("32", "64").encode()


STATEMENTS = st.sampled_from(
    ["x = 1", "# über", "s = '''a\n  b'''", "def f():\n\treturn 1", "", "   ", "t = (1,\n 2)",
     "s = 'ä\\d'", "if 1: pass", "y = 1; \\\nz = 2", "\f"]
)  # fmt: skip
MADE = st.sampled_from([source for source, _ in FORMS.values() if source.startswith("from")])


@given(
    st.lists(STATEMENTS, max_size=4),
    MADE,
    st.lists(STATEMENTS, max_size=4),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["utf-8", "utf-8-sig", "latin-1", "cp1252"]),
    st.booleans(),
)
def test_whatever_stands_around_it_compiles_and_is_undone_to_the_byte(
    above: list[str], made: str, below: list[str], eol: str, encoding: str, ends: bool
) -> None:
    cookie = "" if encoding.startswith("utf") else f"# -*- coding: {encoding} -*-\n"
    text = cookie + "\n".join([*above, made.rstrip("\n"), *below]) + "\n" * ends
    source = text.replace("\n", eol).encode(encoding)
    patched = patch(source)
    assert unpatch(patched) == source
    assert IMPORT.encode() in patched


RUNNER = "from envs.env import Env\n\ndef run():\n    env = Env(10)\n"
MODULES = {
    "c.py": "import runner\nrunner.run()\n", "runner.py": RUNNER, "envs/__init__.py": "",
    "envs/env.py": FORMS["made elsewhere"][0], "unused.py": PLAIN,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, ""),
        ({"deepbots/supervisor.py": FORMS["subclass"][0]}, ""),
        ({"c.py": "from os import path\n"}, "does not import Robot"),
        ({"runner.py": RUNNER + "from controller import Robot\nr = Robot()\n"},
         r"several of its modules make a robot: runner.py line 6, env.py line 4"),
        ({"envs/env.py": PLAIN + "s = Robot()\n"}, r"env.py, which it imports: .*lines 3, 6"),
        ({"envs/env.py": patch(PLAIN.encode()).decode()}, r"env.py, which .* already, in line 2"),
    ],
)  # fmt: skip
def test_a_robot_of_an_imported_module_is_named_with_its_line(
    changed: dict[str, str], said: str, tmp_path: Path
) -> None:
    for name, source in (MODULES | changed).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
    if said:
        with pytest.raises(InvalidInputError, match=said):
            attaching_place(tmp_path / "c.py")
        return
    place = attaching_place(tmp_path / "c.py")
    assert place == (tmp_path / "envs" / "env.py", 4, "MCPBridge.attach(self)")
