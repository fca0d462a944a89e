"""What to install where a command finds a package missing: the bridge is installed without any."""

from __future__ import annotations

from webots_mcp.requirements import checkout, install_line, missing_requirements, package_of


def explain_missing(error: ModuleNotFoundError) -> str:
    """Which packages are missing, and the line that installs them."""
    wanted = missing_requirements()
    if not wanted:
        return (
            f"the Python package {error.name!r} is missing: install webots-mcp with what it "
            f"depends on, by {install_line([checkout()])}"
        )
    names = ", ".join(map(package_of, wanted))
    return (
        f"this command needs packages that a bridge does without, and they are missing: {names}. "
        f"Install them with\n\n    {install_line(wanted)}\n"
    )
