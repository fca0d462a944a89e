"""Resolve ranges once, and read what was recorded in them: frames of rows, changes and gaps."""
