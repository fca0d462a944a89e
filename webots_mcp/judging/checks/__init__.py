"""Checks of a run: is it well? What each looks at, what it found, and what it could not see.

`check_run` makes all checks that its list names; `check` says what a check is. The others hold the
checks, by what they are about.
"""
