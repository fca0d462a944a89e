"""Judgements about what was recorded: events, checks, trends, comparisons, divergence.

They read through `store` and calculate with `analysis`. Questions, steering and plots use them;
they never decide how an answer looks.
"""
