"""Why nothing works: what `webots-mcp doctor` and a client's diagnosis look at."""
