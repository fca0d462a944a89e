"""Run mutation testing on the modules of `modules.toml` and print a score for each.

    python -m tests.mutation                     all modules
    python -m tests.mutation queue policy        only these
    python -m tests.mutation --sample 100        100 mutants of each module, drawn at random

A mutant is a copy of a function with one small fault. It counts as noticed if a test fails or
hangs; the score is the share of mutants that were noticed. mutmut makes the mutants and runs the
tests, in a copy of the checkout in `build/mutation`: the checkout itself is never changed.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

CHECKOUT: Final = Path(__file__).parents[2]
MODULES: Final = Path(__file__).with_name("modules.toml")
SEED: Final = 36  # the same sample for everyone, as long as the module is the same
NOTICED: Final = ("noticed", "timeout", "crashed")
# The exit codes of mutmut's runs of pytest; None where the mutant was not run.
OUTCOMES: Final[dict[int | None, str]] = {
    0: "survived", 1: "noticed", 3: "noticed", 33: "no test", 34: "skipped",
    24: "timeout", -24: "timeout", 36: "timeout", 152: "timeout", 255: "timeout",
    -9: "timeout", -11: "crashed",
}  # fmt: skip
_RUN: Final = "from mutmut.__main__ import cli; cli()"  # with -m it would be imported twice
_LEFT_OUT: Final = (
    ".git", ".venv", ".hypothesis", ".pytest_cache", ".ruff_cache", "__pycache__", "build", "dist",
    "mcp_data",
)  # fmt: skip


@dataclass(frozen=True)
class Module:
    """What is mutated together, and the tests that have to notice.

    Attributes:
        without: Tests of these files that are left out.
    """

    name: str
    files: tuple[str, ...]
    tests: tuple[str, ...]
    without: tuple[str, ...] = ()


def read_modules() -> dict[str, Module]:
    """Return the modules of `modules.toml` by their names."""
    toml: Any = import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    tables: dict[str, dict[str, list[str]]] = toml.loads(MODULES.read_text("utf-8"))
    return {
        name: Module(name, **{key: tuple(values) for key, values in table.items()})
        for name, table in tables.items()
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 0 if all modules were measured, 1 if a run failed."""
    modules = read_modules()
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=f"of {', '.join(modules)}")
    parser.add_argument("--sample", type=int, metavar="N", help="mutants of each module (all)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="mutants at a time (2)")
    options = parser.parse_args(arguments)
    if unknown := set(options.modules) - set(modules):
        parser.error(f"no module {', '.join(sorted(unknown))}: there are {', '.join(modules)}")
    if options.sample is not None and options.sample < 1:
        parser.error(f"--sample {options.sample}: at least one mutant is needed")
    failed = False
    for name in options.modules or modules:
        outcomes = measure(modules[name], options.sample, options.jobs)
        failed |= not outcomes
        print(summary_of(modules[name], outcomes), flush=True)
    return int(failed)


def measure(module: Module, sample: int | None, jobs: int) -> dict[str, str]:
    """Run the mutants of a module.

    Args:
        module: The files to change and the tests to run.
        sample: How many mutants to draw at random; None for all of them.
        jobs: How many run at a time.

    Returns:
        The outcome of each mutant by its name; empty if the tests failed without any fault.
    """
    folder = CHECKOUT / "build" / "mutation" / module.name
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(CHECKOUT, folder, ignore=shutil.ignore_patterns(*_LEFT_OUT))
    project = folder / "pyproject.toml"
    project.write_text(project.read_text("utf-8") + _settings(module, folder), "utf-8")
    names = _mutants_of(module, folder)
    if sample is not None and sample < len(names):
        names = random.Random(SEED).sample(names, sample)
    command = [sys.executable, "-c", _RUN, "run", f"--max-children={jobs}", *sorted(names)]
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
    (folder / "mutmut.log").write_text(process.stdout + process.stderr, "utf-8")
    if process.returncode:
        return {}
    codes = _exit_codes(module, folder)
    return {name: OUTCOMES.get(codes[name], f"exit code {codes[name]}") for name in names}


def _settings(module: Module, folder: Path) -> str:
    """The table [tool.mutmut] of a module: all of the checkout is copied to where tests run."""
    beside = sorted(each.name for each in folder.iterdir() if each.name != "webots_mcp")
    settings = {
        "source_paths": ["webots_mcp"],
        "only_mutate": list(module.files),
        "also_copy": beside,
        "pytest_add_cli_args": [
            *("-p", "no:cacheprovider", "-p", "no:xdist"),
            *(f"--deselect={test}" for test in module.without),
        ],
        "pytest_add_cli_args_test_selection": list(module.tests),
    }
    lines = [f"{name} = {json.dumps(value)}" for name, value in settings.items()]
    return "\n".join(["", "[tool.mutmut]", *lines, ""])


def _mutants_of(module: Module, folder: Path) -> list[str]:
    """The names of all mutants, made by a process that finds the settings in its folder."""
    command = [sys.executable, "-m", "tests.mutation.mutants", *module.files]
    made = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, text=True, check=True)
    return made.stdout.split()


def _exit_codes(module: Module, folder: Path) -> dict[str, int | None]:
    found: dict[str, int | None] = {}
    for file in module.files:
        stored = json.loads((folder / "mutants" / f"{file}.meta").read_text("utf-8"))
        found |= stored["exit_code_by_key"]
    return found


def summary_of(module: Module, outcomes: dict[str, str]) -> str:
    """The score of a module, and each mutant that no test noticed."""
    folder = Path("build") / "mutation" / module.name
    if not outcomes:
        return f"{module.name}: the tests fail without any fault: see {folder / 'mutmut.log'}"
    count = Counter(outcomes.values())
    noticed = sum(count[outcome] for outcome in NOTICED)
    kinds = ", ".join(f"{number} {outcome}" for outcome, number in count.most_common())
    lines = [f"{module.name}: {noticed / len(outcomes):.1%} of {len(outcomes)} mutants ({kinds})"]
    lines += [
        f"  {outcome}: {name}" for name, outcome in outcomes.items() if outcome not in NOTICED
    ]
    if len(lines) > 1:
        lines.append(f"  to see one: cd {folder} && python -m mutmut show NAME")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
