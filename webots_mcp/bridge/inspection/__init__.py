"""Reads the controller's own variables, without running any code of the user."""
