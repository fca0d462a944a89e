"""The recorders beside us, as a controller would use them for its states."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.benchmarks.registry import NotMeasurableError
from tests.benchmarks.states import State


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise NotMeasurableError(
            f"{name.partition('.')[0]} is not installed (pip install --group peers)"
        ) from None


class Mcap:
    """MCAP's Python writer: a JSON message a state, handed to the system at once, in no chunk.

    That is the least that survives the end of the process; there is no index over time.

    Raises:
        NotMeasurableError: mcap is not installed.
    """

    def __init__(self, folder: Path) -> None:
        module = _module("mcap.writer")
        self._file = (folder / "states.mcap").open("wb")
        self._writer = module.Writer(self._file, use_chunking=False)
        self._writer.start()
        schema = self._writer.register_schema("state", "jsonschema", b'{"type": "object"}')
        self._channel = self._writer.register_channel("state", "json", schema)
        self._count = 0

    def publish(self, state: State) -> None:
        """Append the state."""
        self._count += 1
        now = self._count * 8_000_000
        self._writer.add_message(self._channel, now, json.dumps(state).encode(), now)
        self._file.flush()

    def close(self) -> None:
        """Write the summary."""
        self._writer.finish()
        self._file.close()


class Rerun:
    """Rerun's SDK with a file as its sink: a time, a scalar for each number, and a flush.

    Texts and flags are left out.

    Raises:
        NotMeasurableError: rerun-sdk is not installed.
    """

    def __init__(self, folder: Path) -> None:
        self._module = _module("rerun")
        self._stream = self._module.RecordingStream("webots_mcp_benchmark")
        self._stream.save(str(folder / "states.rrd"))
        self._count = 0

    def publish(self, state: State) -> None:
        """Log the state's numbers at the next time."""
        self._count += 1
        self._stream.set_time("sim", duration=self._count * 0.008)
        for path, number in _numbers("state", state):
            self._stream.log(path, self._module.Scalars(number))
        self._stream.flush()

    def close(self) -> None:
        """Close the file."""
        self._stream.disconnect()


def _numbers(path: str, value: Any) -> Iterator[tuple[str, float]]:
    if isinstance(value, (dict, list)):
        items: Any = value.items() if isinstance(value, dict) else enumerate(value)  # pyright: ignore[reportUnknownArgumentType, reportUnknownVariableType]
        for key, item in items:
            yield from _numbers(f"{path}/{key}", item)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield path, value
