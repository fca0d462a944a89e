"""Webots' package `vehicle` as it is in a replay: it answers from a tape."""

from importlib import import_module

from webots_mcp.rerun.replayed_package import make_package

import_module("controller")  # first: the classes of this package derive from its own
make_package("vehicle", globals())
