"""What was recorded: models, chunks, reading, logs, retention, merging, export, permissions.

Judgements, questions and everything above them read through it. It never imports the bridge: both
know the file by `database` alone.
"""
