"""Signals: their names and units, declared parameters, and the condition language.

Everything here works on names and values alone, without a database. The bridge and every folder
above may import it; it imports the standard library and `errors` only.
"""
