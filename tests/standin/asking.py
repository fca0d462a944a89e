"""A controller that evaluates expressions and writes down the shape of each answer.

The file that ASKED names in the environment has one expression a line; the one that ANSWERS names
gets a JSON list of answers and first lines on stderr.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
from math import isnan
from pathlib import Path
from typing import Any, cast

from controller import Field, Node, Robot, Supervisor

STEP_MS = 16
DEVICES = {
    **{"gps": "gps", "imu": "inertial unit", "ds": "ds_left", "cam": "camera", "lid": "lidar"},
    **{"ps": "left wheel sensor", "mot": "left wheel motor"},
}


def shape(value: Any) -> str:
    """The type of an answer, with the value where it is worth comparing."""
    if isinstance(value, list):
        values = cast("list[Any]", value)
        return f"list[{len(values)}] of {shape(values[0]) if values else '-'}"
    if isinstance(value, bytes):
        return f"bytes[{len(value)}]"
    if isinstance(value, float):
        return "float nan" if isnan(value) else "float"
    if value is None or isinstance(value, (bool, int, str)):
        return "None" if value is None else f"{type(value).__name__} {value!r}"
    return f"{type(value).__module__.split('.')[0]}.{type(value).__name__}"


def answer(expression: str, names: dict[str, Any]) -> str:
    """The shape of what an expression gives, or the exception; an assignment gives `ok`."""
    try:
        code = compile(expression, "<asked>", "eval")
    except SyntaxError:
        code = None
    try:
        if code is None:
            exec(expression, names)
            return "ok"
        return shape(eval(code, names))
    except Exception as error:  # noqa: BLE001 - that is an answer too
        return f"EXC {type(error).__name__}: {error}"


def ask(expressions: list[str]) -> list[tuple[str, str]]:
    """Evaluate the expressions in order; what is printed includes what C writes to stderr."""
    names: dict[str, Any] = {"Field": Field, "Node": Node, "Robot": Robot, "signal": signal}
    names |= {"Supervisor": Supervisor, "ts": STEP_MS, "DEFNAME": "ROBOT"}
    answers: list[tuple[str, str]] = []
    with tempfile.TemporaryFile() as printed:
        os.dup2(printed.fileno(), 2)
        for expression in expressions:
            start = printed.seek(0, os.SEEK_END)
            answered = answer(expression, names)
            sys.stderr.flush()
            printed.seek(start)
            line = printed.read().decode().partition("\n")[0]
            answers.append((answered, line))
            if "robot" in names and "gps" not in names:
                names |= {name: names["robot"].devices[key] for name, key in DEVICES.items()}
    return answers


if __name__ == "__main__":
    for name in ("SIGTERM", "SIGHUP", "SIGQUIT"):  # whoever started the tests may ignore them
        signal.signal(getattr(signal, name), signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    asked = Path(os.environ["ASKED"]).read_text(encoding="utf-8").splitlines()
    answered = json.dumps(ask(asked))
    written = Path(os.environ["ANSWERS"])
    written.with_suffix(".part").write_text(answered, encoding="utf-8")
    written.with_suffix(".part").rename(written)
