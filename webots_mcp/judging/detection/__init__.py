"""Events: what was stored when it happened, and what is found in values."""
