"""The folder of the stand-in's `controller` package.

Importing this module makes the package importable. It has to be imported before every module that
imports `controller`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

LIBRARY: Final = Path(__file__).parent / "lib"
"""The folder that holds the `controller` package; it has to come first in PYTHONPATH."""

_loaded = sys.modules.get("controller")
if _loaded is not None and str(LIBRARY) not in str(_loaded.__file__):
    raise ImportError(
        f"another package named controller is loaded, from {_loaded.__file__}: import "
        "webots_mcp.standin before it, or leave Webots' own out of PYTHONPATH"
    )
if str(LIBRARY) not in sys.path:
    sys.path.insert(0, str(LIBRARY))
