"""Define answers: their models, and the tables that fit them into a number of tokens.

Questions and steering build their answers with these modules, which read through `store` and
`judging`. Nothing here declares a tool or sends a command.
"""
