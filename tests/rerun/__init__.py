"""Tapes of controllers, and new code on old runs."""
