"""Tapes: files in which each call of a controller is recorded, next to the database.

The bridge writes them and a rerun reads them. Both use these modules, which need the standard
library only.
"""
