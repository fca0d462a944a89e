"""`python -m webots_mcp` is the console script `webots-mcp`."""

from webots_mcp.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
