"""Random conditions, as trees that can be written as text and judged in the plainest way."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from hypothesis import strategies as st

Node: TypeAlias = "tuple[Any, ...]"
Rows: TypeAlias = "list[tuple[float, dict[str, Any]]]"

CHAINS = ("<", "<=", ">", ">=", "==", "!=")

# -- what is asked -----------------------------------------------------------------------------

signals = st.sampled_from(["x", "y", "a.b"]).map(lambda name: ("signal", name))
constants = st.sampled_from([0, 1, 2, 0.5, 1e200]).map(lambda number: ("number", number))
seconds = st.sampled_from([0.1, 0.2, 0.3, 0.5, 1.0])


def _numbers(inner: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    return st.one_of(
        st.tuples(st.sampled_from("+-*/"), inner, inner),
        st.tuples(st.just("negative"), inner),
        st.tuples(st.sampled_from(["abs", "rate"]), inner),
        st.tuples(st.sampled_from(["min", "max"]), inner, inner),
        st.tuples(st.just("displacement"), seconds),
    )


numbers: st.SearchStrategy[Node] = st.recursive(signals | constants, _numbers, max_leaves=4)
values = st.just(("signal", "mode")) | numbers


def _conditions(inner: st.SearchStrategy[Node]) -> st.SearchStrategy[Node]:
    return st.one_of(
        st.tuples(st.sampled_from(["and", "or"]), inner, inner),
        st.tuples(st.just("not"), inner),
        st.tuples(st.just("for"), inner, seconds),
    )


_first_conditions: st.SearchStrategy[Node] = st.one_of(
    st.tuples(st.sampled_from(CHAINS), numbers, numbers),
    st.tuples(st.just("chain"), numbers, numbers, numbers),
    st.tuples(st.sampled_from(["==", "!="]), st.just(("signal", "mode")), st.just(("text", "a"))),
    st.tuples(st.sampled_from(["changed", "missing"]), values),
    st.just(("flag", "bumper")),
)


def _asks(node: Node) -> bool:
    """Whether it reads anything of a state; what does not is refused."""
    kind, *parts = node
    nodes: list[Node] = [part for part in parts if isinstance(part, tuple)]
    return kind in ("signal", "flag", "displacement") or any(map(_asks, nodes))


conditions: st.SearchStrategy[Node] = st.recursive(
    _first_conditions, _conditions, max_leaves=4
).filter(_asks)


def written(node: Node) -> str:
    """As text, with a parenthesis around everything."""
    kind, *parts = node
    if kind in ("signal", "flag"):
        return str(parts[0])
    if kind == "number":
        return repr(parts[0])
    if kind == "text":
        return f"'{parts[0]}'"
    if kind == "displacement":
        return f"displacement({parts[0]})"
    if kind == "for":
        return f"({written(parts[0])} for {parts[1]})"
    inner = [written(part) for part in parts]
    if kind in ("abs", "rate", "min", "max", "changed", "missing"):
        return f"{kind}({', '.join(inner)})"
    if kind == "chain":
        return f"({inner[0]} < {inner[1]} <= {inner[2]})"
    if kind in ("negative", "not"):
        return f"({'-' if kind == 'negative' else 'not '}{inner[0]})"
    return f"({inner[0]} {kind} {inner[1]})"


# -- what it is asked of -----------------------------------------------------------------------

_number = st.none() | st.sampled_from([0, 1, 2, -1, 0.5, 1.5, math.nan, 1e200])
_states = st.fixed_dictionaries(
    {},
    optional={
        "x": _number,
        "y": _number,
        "a": st.none() | st.fixed_dictionaries({}, optional={"b": _number}),
        "mode": st.sampled_from(["a", "b", None]),
        "bumper": st.sampled_from([True, False, None, 0, 2]),
    },
)


@st.composite
def rows(draw: st.DrawFn) -> Rows:
    """States at rising times, most of them a tenth of a second apart."""
    states = draw(st.lists(_states, min_size=1, max_size=12))
    steps = draw(st.lists(st.sampled_from([1, 1, 1, 2, 9]), min_size=12, max_size=12))
    at = [sum(steps[:i]) / 10 for i in range(len(states))]
    return [(time_s, {"x": 0.0, "y": 0.0, **s}) for time_s, s in zip(at, states, strict=True)]


# -- what is true ------------------------------------------------------------------------------
