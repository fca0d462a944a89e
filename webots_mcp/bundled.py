"""Files that belong to the package but stand beside it in a checkout: migrations, examples."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parent


def bundled(name: str) -> Path:
    """The folder `name`: inside the package in a wheel, beside it in a checkout.

    Raises:
        FileNotFoundError: It is in neither place; the installation is broken.
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"{name}/ is missing: install webots-mcp again")
