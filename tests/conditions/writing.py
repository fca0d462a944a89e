"""Random conditions, as trees that can be written as text and judged in the plainest way."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

from hypothesis import strategies as st

Node: TypeAlias = "tuple[Any, ...]"
Rows: TypeAlias = "list[tuple[float, dict[str, Any]]]"

TOLERANCE_S = 1e-6
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


def judged(node: Node, history: Rows) -> bool:
    """Whether a condition holds in the last of the rows, looked up from the begin each time."""
    kind, *parts = node
    if kind in ("and", "or"):
        both = [judged(part, history) for part in parts]
        return all(both) if kind == "and" else any(both)
    if kind == "not":
        return not judged(parts[0], history)
    if kind == "for":
        return _lasted(parts[0], parts[1], history)
    if kind == "flag":
        return bool(history[-1][1].get(parts[0]))
    if kind == "missing":
        return valued(parts[0], history) is None
    if kind == "changed":
        seen = [valued(parts[0], history[: i + 1]) for i in range(len(history))]
        there = [value for value in seen if value is not None]
        return seen[-1] is not None and len(there) > 1 and there[-1] != there[-2]
    if kind == "chain":
        low, middle, high = (valued(part, history) for part in parts)
        return _compared("<", low, middle) and _compared("<=", middle, high)
    return _compared(kind, *(valued(part, history) for part in parts))


def _lasted(condition: Node, seconds: float, history: Rows) -> bool:
    since_s = None
    for i in reversed(range(len(history))):
        if not judged(condition, history[: i + 1]):
            break
        since_s = history[i][0]
    return since_s is not None and history[-1][0] - since_s >= seconds - TOLERANCE_S


def _compared(sign: str, a: Any, b: Any) -> bool:
    if a is None or b is None:
        return False
    outcomes = {
        "<": lambda: a < b,
        "<=": lambda: a <= b,
        ">": lambda: a > b,
        ">=": lambda: a >= b,
        "==": lambda: a == b,
        "!=": lambda: a != b,
    }
    return bool(outcomes[sign]())


def valued(node: Node, history: Rows) -> Any:
    """A value in the last of the rows; None where it has none."""
    kind, *parts = node
    if kind in ("number", "text"):
        return parts[0]
    if kind == "signal":
        return _usable(_looked_up(parts[0], history[-1][1]))
    if kind == "displacement":
        return _displaced(parts[0], history)
    if kind == "rate":
        return _usable(_rate(parts[0], history))
    known = [valued(part, history) for part in parts]
    if None in known:
        return None
    try:
        return _usable(_worked_out(kind, known))
    except (ZeroDivisionError, OverflowError):
        return None


def _worked_out(kind: str, known: list[Any]) -> Any:
    if kind == "negative":
        return -known[0]
    if kind == "abs":
        return abs(known[0])
    a, b = known
    return {
        "+": lambda: a + b,
        "-": lambda: a - b,
        "*": lambda: a * b,
        "/": lambda: a / b,
        "min": lambda: min(a, b),
        "max": lambda: max(a, b),
    }[kind]()


def _looked_up(name: str, state: Any) -> Any:
    for part in name.split("."):
        state = state.get(part) if isinstance(state, dict) else None
    return state


def _usable(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _rate(node: Node, history: Rows) -> Any:
    there = [
        (history[i][0], value)
        for i in range(len(history))
        if (value := valued(node, history[: i + 1])) is not None
    ]
    if len(there) < 2 or there[-1][0] != history[-1][0]:
        return None
    (before_s, before), (now_s, now) = there[-2:]
    return (now - before) / (now_s - before_s)


def _displaced(seconds: float, history: Rows) -> Any:
    places = [
        (time_s, x, y)
        for time_s, state in history
        if (x := _usable(state["x"])) is not None
        and (y := _usable(state["y"])) is not None
        and max(abs(x), abs(y)) < 1e9
    ]
    now_s = history[-1][0]
    before = [place for place in places if place[0] <= now_s - seconds + TOLERANCE_S]
    if not before or places[-1][0] != now_s:
        return None
    if now_s - before[-1][0] > 2 * seconds + TOLERANCE_S:
        return None
    return math.dist(before[-1][1:], places[-1][1:])
