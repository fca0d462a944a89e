"""Rollups: 10 s of each signal, kept beside the state rows by the maintainer."""
