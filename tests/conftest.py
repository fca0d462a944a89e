"""What holds for all tests, however they were started."""

from __future__ import annotations

import signal

from hypothesis import settings

# The same examples each time, so that a red run was made red by the change that it tests;
# `pytest --hypothesis-profile=explore` looks for new ones.
settings.register_profile("repeatable", derandomize=True)
settings.register_profile("explore", derandomize=False, print_blob=True)
settings.load_profile("repeatable")

# A script's background jobs ignore Ctrl-C and hand that down to the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
