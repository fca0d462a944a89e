"""Ask every question of every golden recording: `python -m tests.golden [--accept] [NAME ...]`.

Without `--accept` it prints how the answers differ from those stored in `answers/`; with it today's
answers take their place, all of them or those of the questions that `--question` names. Whoever
accepts says in the commit why each answer changed.
"""

from __future__ import annotations

import argparse
import logging
import sys
from fnmatch import fnmatchcase

from tests.golden.recordings import RECORDINGS
from tests.golden.stored import answers_of, difference, store, stored


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(RECORDINGS)}")
    parser.add_argument("--accept", action="store_true", help="store today's answers")
    parser.add_argument(
        "--question", action="append", metavar="PATTERN",
        help="only these questions, such as 'check*' or 'events*'; may be given several times",
    )  # fmt: skip
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(RECORDINGS):
        parser.error(f"no recording {', '.join(unknown)}: there are {', '.join(RECORDINGS)}")
    logging.disable(logging.WARNING)  # of client and server: each call
    differing = 0
    for name in arguments.names or RECORDINGS:
        answers = answers_of(name)
        if patterns := arguments.question:
            accepted = {
                asked: text
                for asked, text in stored(name).items()
                if not any(fnmatchcase(asked, each) for each in patterns)
            }
            answers |= accepted
        found = difference(name, answers)
        differing += bool(found)
        print(found or f"{name}: {len(answers)} answers as stored")
        if arguments.accept:
            store(name, answers)
    return 1 if differing and not arguments.accept else 0


if __name__ == "__main__":
    sys.exit(main())
