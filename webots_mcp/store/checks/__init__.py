"""Checks of a run: is it well? What each looks at, what it found, and what it could not see."""
