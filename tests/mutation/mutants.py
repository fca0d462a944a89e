"""Print the names of all mutants of some files, as mutmut makes them in the working folder."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any


def main() -> None:
    making: Any = import_module("mutmut.mutation.file_mutation")
    naming: Any = import_module("mutmut.utils.format_utils")
    for file in sys.argv[1:]:
        source = Path(file).read_text("utf-8")
        for name in making.mutate_file_contents(file, source, None, None).mutant_names:
            print(naming.get_mutant_name(Path(file), name))


if __name__ == "__main__":
    main()
