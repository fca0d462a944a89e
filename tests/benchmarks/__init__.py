"""What the bridge and the server cost, in comparison with raw sqlite3.

    python -m tests.benchmarks [--quick] [--rows ROWS] [--kills KILLS] [--only NAME]

One table of ratios. The contenders of a line take turns in blocks, in one run on one machine, so
that whatever else the machine does falls on all of them. Nothing passes or fails by the clock:
each line has its target next to it.

A benchmark is a function under `@benchmark` that yields lines, named in `BENCHMARKS` of its module.
"""
