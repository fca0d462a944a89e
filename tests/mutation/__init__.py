"""Mutation testing of the modules that may lose nothing: `modules.toml` names them."""
