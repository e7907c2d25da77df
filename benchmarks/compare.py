"""The tables of docs/results.md and docs/reproduce.md, from the results in ``benchmarks/results``.

    python benchmarks/compare.py page

writes both pages anew: the first table under ``<!-- overview -->``, tables that stand under ``<!-- table: FAMILY LABEL
-->``, those of a study's family under ``<!-- study: NAME FAMILY -->``, and the list of studies under ``<!-- studies -->``.
``fedguide benchmark --study benchmarks/studies/NAME.yml`` does a study's runs.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

from sb3_fedguide.benchmark.results import Measures, best_known, measure, read_results
from sb3_fedguide.cli.benchmark import prepare_benchmark
from sb3_fedguide.cli.benchmark_arguments import parse_benchmark
from sb3_fedguide.cli.benchmark_costs import total_hours
from sb3_fedguide.cli.benchmark_results import make_tables, results_of_rows
from sb3_fedguide.cli.benchmark_tables import markdown
from sb3_fedguide.cli.study_file import read_study

HERE = Path(__file__).resolve().parent
RESULTS, STUDIES = HERE / "results", HERE / "studies"
#: Families of the first table, and the labels of their results.
OVERVIEW = {
    "Hopper": "tuned", "HopperHard": "tuned", "Walker2D": "tuned", "Walker2DHard": "tuned", "HalfCheetah": "tuned",
    "HalfCheetahHard": "tuned", "Reacher": "tuned", "ReacherHard": "tuned", "PointMazeHard": "20rounds",
    "MetaWorld10": "tuned",
}  # fmt: skip
PAGE, LIST = HERE.parent / "docs" / "results.md", HERE.parent / "docs" / "reproduce.md"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("command", choices=("page",))
    parser.parse_args()
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    LIST.write_text(with_studies(LIST.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


def with_tables(text: str) -> str:
    """The page with every marked table as the results give it."""
    text = _replaced(
        r"table: (?P<family>\S+) (?P<label>\S+)", text,
        lambda match: _table("--envs", match["family"], "--label", match["label"], "-f", str(RESULTS)),
    )  # fmt: skip
    text = _replaced("overview", text, lambda match: overview())
    return _replaced(
        r"study: (?P<name>\S+) (?P<family>\S+)", text,
        lambda match: _table("--study", str(STUDIES / f"{match['name']}.yml"), "--envs", match["family"]),
    )  # fmt: skip


def overview() -> str:
    """Local and FedGuide-R on every family that has results of both, as a Markdown table."""
    lines = [
        "| family | seeds: local, fedguide-r | F: local | fedguide-r | ratio | difference | worst client | stuck | speed-up |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for family, label in OVERVIEW.items():
        found = read_results(RESULTS, family, label, ["local", "fedguide-r"])
        if len(found) == 2:
            local, ours = found["local"], found["fedguide-r"]
            best = best_known([*local, *ours])
            lines.append(_overview_row(family, measure(local, best_known=best), measure(ours, (), local, best)))
    return "\n".join(lines)


def _overview_row(family: str, local: Measures, ours: Measures) -> str:
    def change(name: str) -> str:
        before, after = getattr(local, name), getattr(ours, name)
        return "-" if before is None or after is None else f"{before:.4g} → {after:.4g}"

    interval = ours.difference_interval
    spread = "" if interval is None else f" ({interval[0]:.3g} to {interval[1]:.3g})"
    difference = "-" if ours.difference is None else f"{ours.difference:+.3g}{spread}"
    cells = [
        family, f"{len(local.seeds)}, {len(ours.seeds)}", f"{local.F:.4g}", f"{ours.F:.4g}",
        f"{ours.F / local.F:.2f}" if local.F > 0 else "-", difference,
        change("worst_client"), change("stuck"), "-" if ours.speed_up is None else f"{ours.speed_up:.2f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def with_studies(text: str) -> str:
    """The page with the list of studies: what each is about, what it costs, and what of it has been done."""
    return _replaced("studies", text, lambda match: studies())


def studies() -> str:
    """The list of studies as a Markdown table."""
    lines = ["| study | what | runs, of which done | CPU hours of all |", "|---|---|---|---|"]
    for path in sorted(STUDIES.glob("*.yml")):
        study = read_study(path)
        with tempfile.TemporaryDirectory() as nothing:
            arguments = parse_benchmark(["--study", str(path), "--dry-run", "-f", nothing], "compare.py")
            plan = prepare_benchmark(arguments, "compare.py")  # which puts into arguments what the file says
        found = results_of_rows(study.folder, plan.families, plan.rows)
        done = sum(len(results) for rows in found.values() for results in rows.values())
        hours = total_hours(plan, arguments.eval_freq, arguments.eval_episodes)
        lines.append(f"| `{path.stem}` | {study.title} | {len(plan.runs)}, {done} | {hours:.0f} |")
    return "\n".join(lines)


def _table(*flags: str) -> str:
    arguments = parse_benchmark([*flags, "--table-only"], "compare.py")
    plan = prepare_benchmark(arguments, "compare.py")
    assert plan.results is not None
    tables = markdown(make_tables(arguments, plan.families, plan.results))
    return "\n".join(line for line in tables.splitlines() if line.startswith("|"))


def _replaced(marker: str, text: str, table: Callable[[re.Match[str]], str]) -> str:
    pattern = rf"(?P<marker><!-- {marker} -->)\n(?:\n?\|.*\n)*"
    return re.sub(pattern, lambda match: f"{match['marker']}\n{table(match)}\n", text)


if __name__ == "__main__":
    raise SystemExit(main())
