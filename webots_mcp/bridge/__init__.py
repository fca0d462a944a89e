"""The part that runs inside a robot's controller: publishing, commands, pauses, the scene.

Controllers import it through `webots_mcp`; in this package only the observer does. It imports the
standard library, `database` and `signals`, and orjson where that is installed.
"""
