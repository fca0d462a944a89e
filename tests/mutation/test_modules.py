"""What `./run mutation` measures is there, and its outcomes are counted."""

from __future__ import annotations

import pytest

from tests.mutation.__main__ import CHECKOUT, Module, main, read_modules, summary_of

MODULES = read_modules()


@pytest.mark.parametrize("module", MODULES.values(), ids=MODULES)
def test_the_files_and_the_tests_of_a_module_are_there(module: Module) -> None:
    assert [each for each in (*module.files, *module.tests) if not (CHECKOUT / each).exists()] == []
    assert module.files
    assert module.tests


def test_the_score_is_the_share_of_noticed_mutants_and_names_the_others() -> None:
    outcomes = {"a": "noticed", "b": "timeout", "c": "survived", "d": "no test"}
    first, *others, hint = summary_of(MODULES["queue"], outcomes).splitlines()
    assert first.startswith("queue: 50.0% of 4 mutants")
    assert others == ["  survived: c", "  no test: d"]
    assert "show NAME" in hint


@pytest.mark.parametrize("arguments", [["no such module"], ["queue", "--sample", "0"]])
def test_a_wrong_argument_is_named(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert {"queue": "at least one mutant", "no such module": "there are queue"}[
        arguments[0]
    ] in capsys.readouterr().err
