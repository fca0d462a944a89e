"""Ranges resolved once, and what was recorded in them: rows, rollups, changes and gaps."""
