"""Asks every question of every golden recording: `python -m tests.golden [--accept] [NAME ...]`.

Without `--accept` it prints how the answers differ from those stored in `answers/`; with it those
of today take their place. Whoever accepts says in the commit why each answer changed.
"""

from __future__ import annotations

import argparse
import logging
import sys

from tests.golden.drawing import KINDS
from tests.golden.stored import answers_of, difference, store


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(KINDS)} (all)")
    parser.add_argument("--accept", action="store_true", help="store the answers of today")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(KINDS):
        parser.error(f"no recording {', '.join(unknown)}: there is {', '.join(KINDS)}")
    logging.disable(logging.WARNING)  # of client and server: each call
    differing = 0
    for name in arguments.names or KINDS:
        answers = answers_of(name)
        found = difference(name, answers)
        differing += bool(found)
        print(found or f"{name}: {len(answers)} answers as stored")
        if arguments.accept:
            store(name, answers)
    return 1 if differing and not arguments.accept else 0


if __name__ == "__main__":
    sys.exit(main())
