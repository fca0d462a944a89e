"""Each promise stands in its page, and what shows it is there: who renames a test says so here."""

from __future__ import annotations

import pytest

from tests.promises.table import Promise, is_there, read_promises, stands_in_its_page

PROMISES = read_promises()
PAGES = list(dict.fromkeys(promise.page for promise in PROMISES))


@pytest.mark.parametrize("page", PAGES)
def test_each_promise_stands_verbatim_in_its_page(page: str) -> None:
    ours = [promise for promise in PROMISES if promise.page == page]
    assert {each.says for each in ours if not stands_in_its_page(each)} == set()
    assert len({each.says for each in ours}) == len(ours)


@pytest.mark.parametrize("page", PAGES)
def test_what_shows_a_promise_is_there(page: str) -> None:
    missing = {
        (promise.says, shown_by)
        for promise in PROMISES
        for shown_by in promise.shown_by
        if promise.page == page and not is_there(shown_by)
    }
    assert missing == set()


def test_of_what_nothing_shows_it_is_said_why() -> None:
    assert {each.says for each in PROMISES if not each.shown_by and not each.why} == set()


@pytest.mark.parametrize(
    ("shown_by", "why", "word"),
    [
        ((), "no machine for it", "unshown"),
        (("benchmark kills",), "", "measured"),
        (("a", "benchmark kills"), "", "kept"),
        (("a", "b"), "not on Windows", "partly"),
        (("a", "s"), "", "partly"),
        (("s",), "", "skipped"),
        (("a", "f"), "", "broken"),
        (("a", "gone"), "", "broken"),
    ],
)
def test_a_promise_is_kept_where_all_of_its_tests_pass(
    shown_by: tuple[str, ...], why: str, word: str
) -> None:
    outcomes = {"a": "passed", "b": "passed", "s": "skipped", "f": "failed"}
    assert Promise("README.md", "It works.", shown_by, why).judge(outcomes) == word
