"""Webots' package `controller` as it is in a replay: it answers from a tape."""

from webots_mcp.rerun.replayed_package import make_package

make_package("controller", globals())
