"""Trials from the shell: a plan, and a simulator of its own for each trial; see docs/trials.md."""
