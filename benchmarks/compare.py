"""The comparisons of docs/results.md: ``fedguide benchmark`` with its results in ``benchmarks/results``.

    python benchmarks/compare.py run --env HopperHard --seeds 0 1 2 --processes 2
    python benchmarks/compare.py table --env HopperHard

``run`` takes further flags of the command, such as ``-params``; ``table`` prints Markdown.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from sb3_fedguide.cli.benchmark import main as benchmark

RESULTS = Path(__file__).resolve().parent / "results"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("command", choices=("run", "table"))
    parser.add_argument("--env", nargs="+", default=["HopperHard"], help="families")
    parser.add_argument("--conf", default="tuned", help="configuration")
    parser.add_argument("--methods", nargs="+", help="by default all")
    parser.add_argument("--seeds", nargs="+", help="by default 0 1 2, and in tables all that there are")
    parser.add_argument("--processes", default="2", help="runs at a time")
    arguments, more = parser.parse_known_args()
    flags = ["--envs", *arguments.env, "-conf", arguments.conf, "-f", os.path.relpath(RESULTS)]
    flags += ["--algos", *arguments.methods] if arguments.methods else []
    if arguments.command == "table":
        flags += ["--seeds", *arguments.seeds] if arguments.seeds else []
        return benchmark([*flags, *more, "--table-only", "--markdown"])
    return benchmark([*flags, "--seeds", *(arguments.seeds or "012"), "--processes", arguments.processes, *more])


if __name__ == "__main__":
    raise SystemExit(main())
