"""What is known of the Webots program from outside: where it is, which run, how to speak to them.

What Webots' sources say about each version, and what happens here if it is otherwise, is listed in
docs/webots.md.
"""
