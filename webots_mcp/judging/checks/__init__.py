"""Checks of a run: did it go well? What each check reads, what it found, what it could not judge.

`check_run` makes all checks that its list names; `check` says what a check is. The others hold the
checks, by what they are about.
"""
