"""The part that runs inside a robot's controller. Standard library only (orjson if present)."""
