"""Print which situations are answered: `python -m tests.cases [WORD...]`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from tests.cases import healthy_robots, problems
from tests.cases.public import PUBLIC, RIGHT, labels, score
from tests.cases.situations import HEALTHY, PROBLEMS, failures

_MODULES = (healthy_robots, problems)  # which fill the registries


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 1 if a situation is answered wrongly that is not known as a gap."""
    parser = argparse.ArgumentParser(prog="python -m tests.cases", description=__doc__)
    parser.add_argument("words", nargs="*", metavar="WORD", help="only situations of these words")
    words = parser.parse_args(arguments).words
    unexpected = 0
    for title, registry in (("Healthy robots", HEALTHY), ("Problems", PROBLEMS)):
        print(title)
        for name, each in registry.items():
            if all(word in name for word in words):
                wrong = failures(each)
                unexpected += bool(wrong) and not each.known_gap
                print(f"  {'no ' if wrong else 'yes'} {name}", *wrong, sep="\n        ")
    print("Public situations that were labelled first")
    points = most = 0
    for name in PUBLIC:
        if all(word in name for word in words):
            found = score(name)
            points, most = points + found.points, most + RIGHT
            print(f"  {found.points:>2}  {labels()[name]['situation']}\n        {found.answered}")
    print(f"{points} of {most} points")
    return int(unexpected > 0)


if __name__ == "__main__":
    raise SystemExit(main())
