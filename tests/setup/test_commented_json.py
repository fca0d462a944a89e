"""A member is put into a JSON text that people write; the rest of the text stays as it was."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from webots_mcp.errors import InvalidInputError
from webots_mcp.setup.client_entries import CommentedJSON

ENTRY = {"command": "/a b/python", "args": ["serve"]}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(
    st.dictionaries(st.text(), VALUES, max_size=4),
    st.dictionaries(st.text(), VALUES, max_size=3) | st.none(),
    st.sampled_from([None, 2, "\t"]),
)
def test_every_other_value_is_kept_in_its_order(
    others: dict[str, Any], servers: dict[str, Any] | None, indent: int | str | None
) -> None:
    held = others | ({} if servers is None else {"mcpServers": servers})
    after = CommentedJSON(json.dumps(held, indent=indent)).with_member(("mcpServers", "w"), ENTRY) \
        if isinstance(held.get("mcpServers", {}), dict) else None  # fmt: skip
    if after is not None:
        found = json.loads(after)
        assert found == held | {"mcpServers": {**(held.get("mcpServers") or {}), "w": ENTRY}}
        assert [name for name in found if name in held] == list(held)


COMMENTED = """// mine
{
    /* about { servers */
    "servers": {
        "other": {"url": "http://x//y"}, // not a comment: //y
    }, // end
    "inputs": [],
}
"""


def test_comments_trailing_commas_and_indentation_stay() -> None:
    after = CommentedJSON(COMMENTED).with_member(("servers", "webots"), {"command": "w"})
    assert after == COMMENTED.replace(
        '"servers": {\n',
        '"servers": {\n        "webots": {\n          "command": "w"\n        },\n',
    )
    assert CommentedJSON(after).value["servers"]["webots"] == {"command": "w"}


@pytest.mark.parametrize(
    "text",
    ["{}", "{ }\n", "{\n}\n", '{"a": 1}', '{"a": 1 // one\n}', "{ // nothing yet\n}",
     '{"servers": {}}', '{"servers": {\n    // none\n  }\n}', '{"servers": {"a": 1,},}'],
)  # fmt: skip
def test_each_comment_and_value_is_still_there(text: str) -> None:
    before = CommentedJSON(text)
    after = CommentedJSON(before.with_member(("servers", "w"), 1))
    assert after.value["servers"]["w"] == 1
    assert {name: value for name, value in after.value.items() if name != "servers"} == {
        name: value for name, value in before.value.items() if name != "servers"
    }
    assert after.text.count("//") == text.count("//")


def test_lines_end_as_those_before() -> None:
    after = CommentedJSON('{\r\n  "a": 1\r\n}\r\n').with_member(("b",), {"c": 2})
    assert after == '{\r\n  "b": {\r\n    "c": 2\r\n  },\r\n  "a": 1\r\n}\r\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{\n  "a": 1\n  "b": 2\n}', "line 3, column 3"),
        ("[1]", "no JSON object"),
        ('{"a": 1, "a": 2}', '"a" is there twice'),
        ('{"a": "open', "line 1"),
        ("[" * 100_000, "too deep"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_place(text: str, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        CommentedJSON(text)


def test_a_value_on_the_way_is_not_replaced() -> None:
    with pytest.raises(InvalidInputError, match='"servers" holds no object'):
        CommentedJSON('{"servers": [1]}').with_member(("servers", "w"), 1)
