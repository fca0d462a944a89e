"""Store what was recorded: models, chunks, reading, logs, retention, merging, export, permissions.

Judgements, questions and everything above them read through this package. It never imports the
bridge; the two share the file only through `database`.
"""
