"""The comparisons of docs/results.md: ``fedguide benchmark`` with its results in ``benchmarks/results``.

    python benchmarks/compare.py run --env HopperHard --seeds 0 1 2 --processes 2
    python benchmarks/compare.py table --env HopperHard
    python benchmarks/compare.py page

``run`` takes further flags of the command, such as ``-params``; ``table`` prints Markdown; ``page`` writes every table of
docs/results.md anew: those that stand under ``<!-- table: FAMILY LABEL -->``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
from pathlib import Path

from sb3_fedguide.cli.benchmark import main as benchmark

RESULTS = Path(__file__).resolve().parent / "results"
PAGE = RESULTS.parents[1] / "docs" / "results.md"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("command", choices=("run", "table", "page"))
    parser.add_argument("--env", nargs="+", default=["HopperHard"], help="families")
    parser.add_argument("--conf", default="tuned", help="configuration")
    parser.add_argument("--methods", nargs="+", help="by default all")
    parser.add_argument("--seeds", nargs="+", help="by default 0 1 2, and in tables all that there are")
    parser.add_argument("--processes", default="2", help="runs at a time")
    arguments, more = parser.parse_known_args()
    if arguments.command == "page":
        PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
        return 0
    flags = ["--envs", *arguments.env, "-conf", arguments.conf, "-f", os.path.relpath(RESULTS)]
    flags += ["--algos", *arguments.methods] if arguments.methods else []
    if arguments.command == "table":
        flags += ["--seeds", *arguments.seeds] if arguments.seeds else []
        return benchmark([*flags, *more, "--table-only", "--markdown"])
    return benchmark([*flags, "--seeds", *(arguments.seeds or "012"), "--processes", arguments.processes, *more])


def with_tables(text: str) -> str:
    """The page with every marked table as the results give it."""
    return re.sub(r"<!-- table: (\S+) (\S+) -->\n(?:\n?\|.*\n)*", lambda match: _table(match[1], match[2]), text)


def _table(family: str, label: str) -> str:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        benchmark(["--envs", family, "--label", label, "-f", str(RESULTS), "--table-only", "--markdown"])
    rows = [line for line in printed.getvalue().splitlines() if line.startswith("|")]
    return "\n".join([f"<!-- table: {family} {label} -->", *rows, ""])


if __name__ == "__main__":
    raise SystemExit(main())
