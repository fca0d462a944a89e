"""Prints which check noticed which kind of fault, and what was said of healthy runs."""

from __future__ import annotations

import sys

from tests.judging.checks.judging import judge, render

if __name__ == "__main__":
    print(render(judge(int(sys.argv[1]) if len(sys.argv) > 1 else 50)))
