"""Rollups: 10 s of each signal, kept in addition to the state rows by the maintainer."""
