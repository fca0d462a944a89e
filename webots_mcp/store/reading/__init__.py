"""Ranges resolved once, and what was recorded in them: frames of rows, changes and gaps."""
