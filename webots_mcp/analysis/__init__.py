"""Arithmetic on what was read: no SQL, and no words for people."""
