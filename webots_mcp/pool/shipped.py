"""What of a recording its pools hold: a small file in the data folder, which retention reads.

The progress itself is at the pool. This file only spares what is not there yet: where it is lost or
cannot be written, rows are kept that need not be, within the limit of `--keep-until-shipped`.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

NAME: Final = "shipped.json"


@dataclass(frozen=True)
class Shipped:
    """What one pool holds of a recording.

    Attributes:
        recording: Its UUID.
        last_ids: By table, up to which row it was shipped; of `state` only at full rate.
        complete_wall_time_s: All that was recorded before was shipped; 0 before the first time.
        wall_time_s: When that was so.
    """

    recording: str
    last_ids: Mapping[str, int]
    complete_wall_time_s: float
    wall_time_s: float


def read_shipped(data_dir: Path, recording: str) -> dict[str, Shipped]:
    """What each pool holds of a recording, by the pool's address; a damaged file says nothing."""
    return {
        address: shipped
        for address, shipped in _read(data_dir).items()
        if shipped.recording == recording
    }


def write_shipped(data_dir: Path, address: str, shipped: Shipped) -> None:
    """Say what a pool holds now.

    Raises:
        OSError: The folder cannot be written.
    """
    file = data_dir / NAME
    told = {**_read(data_dir), address: shipped}
    aside = file.with_name(f".{NAME}.{os.getpid()}.part")
    try:
        aside.write_text(json.dumps({key: asdict(each) for key, each in told.items()}, indent=1))
        aside.replace(file)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink()
        raise


def _read(data_dir: Path) -> dict[str, Shipped]:
    try:
        told: Any = json.loads((data_dir / NAME).read_text("utf-8"))
        return {str(address): _shipped(each) for address, each in told.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}


def _shipped(told: Any) -> Shipped:
    return Shipped(
        str(told["recording"]),
        {str(name): int(last) for name, last in told["last_ids"].items()},
        float(told["complete_wall_time_s"]),
        float(told["wall_time_s"]),
    )
