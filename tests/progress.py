"""What a run of the tests prints: a line when a file ends, and the reasons of skipped tests.

It works the same beside xdist, which reports tests of several files in turn, and in a log file.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any, Final

import pytest

SILENCE_S: Final = 30.0  # after which a file that goes on is named
_USUAL: Final = (-1, 0)  # the verbosity; at others pytest prints what was asked for


class Progress:
    """Prints a line for each file of tests that has ended, and each failure at once."""

    def __init__(self, reporter: Any) -> None:
        self._reporter = reporter
        self._started_s = self._printed_s = time.monotonic()
        self._expected: Counter[str] = Counter()
        self._done: Counter[str] = Counter()
        self._outcomes: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._lasted_s: defaultdict[str, float] = defaultdict(float)

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Know what will run in this process."""
        if session.items:  # none where the workers of xdist have them
            self._expect(item.nodeid for item in session.items)

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Know what will run in the workers, which all collect the same."""
        self._expect(ids)

    def _expect(self, ids: Iterable[str]) -> None:
        self._expected = Counter(_file(each) for each in ids)

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str]:
        """Count an outcome as pytest does, without its letter."""
        if hasattr(report, "wasxfail"):
            return ("xfailed" if report.skipped else "xpassed", "", "")
        if report.failed and report.when != "call":
            return ("error", "", "ERROR")
        is_counted = report.when == "call" or not report.passed
        return (report.outcome if is_counted else "", "", "FAILED" if report.failed else "")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a part of a test; print where its file has ended or it has failed."""
        file = _file(report.nodeid)
        self._lasted_s[file] += report.duration
        if report.when == "call" or not report.passed:
            self._outcomes[file][report.outcome] += 1
        if report.failed:
            self._print(f"FAILED {report.nodeid}" + ("" if report.when == "call" else " (fixture)"))
        if report.when != "teardown":
            return
        self._done[file] += 1
        if self._done[file] == self._expected[file]:
            self._print(f"{file}  {self._outcomes_of(file)}")
        elif time.monotonic() - self._printed_s > SILENCE_S:
            self._print(f"{file}  {self._done[file]} of {self._expected[file]} tests so far")

    def _outcomes_of(self, file: str) -> str:
        outcomes = self._outcomes[file]
        counts = (f"{outcomes[each]} {each}" for each in ("failed", "passed", "skipped"))
        shown = ", ".join(each for each in counts if not each.startswith("0 "))
        return f"{shown} in {self._lasted_s[file]:.1f} s"

    def _print(self, text: str) -> None:
        self._printed_s = time.monotonic()
        done, expected = self._done.total(), self._expected.total()
        minutes, seconds = divmod(int(self._printed_s - self._started_s), 60)
        share = 100 * done // expected if expected else 0
        self._reporter.ensure_newline()
        count = f"{done:{len(str(expected))}} of {expected}"
        self._reporter.write_line(f"{share:3} %  {count}  {minutes}:{seconds:02}  {text}")


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]


@pytest.hookimpl(trylast=True)  # pytest has its own reporter by then
def pytest_configure(config: pytest.Config) -> None:
    """Take the place of pytest's dots, where nobody has asked for more or less than usual."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter and config.get_verbosity() in _USUAL and not hasattr(config, "workerinput"):
        reporter._show_progress_info = False  # the share that is done stands in each line
        config.pluginmanager.register(Progress(reporter), "tests.progress of files")


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the tests that were skipped by the reason for it."""
    skipped: defaultdict[str, Counter[str]] = defaultdict(Counter)
    stats = terminalreporter.stats
    for report in [*stats.get("skipped", ()), *stats.get("xfailed", ())]:
        skipped[_reason(report)][report.nodeid.partition("[")[0]] += 1
    if not skipped:
        return
    terminalreporter.section("skipped tests")
    for reason, tests in sorted(skipped.items()):
        terminalreporter.write_line(f"{reason}:")
        for test, count in sorted(tests.items()):
            terminalreporter.write_line(f"  {test}" + (f" ({count} times)" if count > 1 else ""))


def _reason(report: Any) -> str:
    if hasattr(report, "wasxfail"):
        return f"expected to fail: {report.wasxfail}"
    told = report.longrepr
    reason = told[2] if isinstance(told, tuple) else str(told)
    return reason.removeprefix("Skipped: ")
