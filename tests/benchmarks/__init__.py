"""What the bridge and the server cost, beside the JSON-file way and raw sqlite3.

    python -m tests.benchmarks [--quick] [--rows ROWS] [--only NAME]

One table of ratios. The contenders of a line take turns in blocks, in one run on one machine, so
that whatever else the machine does falls on all of them. Nothing passes or fails by the clock:
each line stands beside its target.

- `measuring`, `table`: the tiny core.
- `ways`: the three ways to record that are compared; `rover`: the robot and its state.
- `recordings`: long runs, of which questions are asked.
- `families`: one module per family of lines. A new line is a `yield` in one of them, a new family
  a module there with a function under `@benchmark`: nothing else needs to know of it.
- `programs`: what has to run in a process of its own.
"""
