"""Calculations on columns of numbers: summaries, paths, standstills, oscillations.

Nothing here reads a database, knows what a signal means or has words for people. The store and
every folder above it use these functions; they import numpy only.
"""
