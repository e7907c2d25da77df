"""Tables of a benchmark: on the terminal, as Markdown, LaTeX, JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.report import format_size

if TYPE_CHECKING:
    from sb3_fedguide.benchmark.aggregate import Aggregate
    from sb3_fedguide.benchmark.results import Measures


@dataclass(frozen=True)
class Tables:
    """The tables of a benchmark.

    :param families: name of the results, such as ``HopperHard-tuned``, to one row per method
    :param aggregates: methods over all families; empty for a single one
    :param notes: remarks below the tables
    :param overview: columns that get their own table, with a row per family and a column per method
    """

    families: Mapping[str, Sequence[Measures]]
    aggregates: Sequence[Aggregate]
    notes: Sequence[str]
    overview: Sequence[str] = ()


Row = dict[str, str]

#: Below the tables on the terminal.
LEGEND = (
    "F: client-average return at the end, mean ± standard deviation over seeds; W: its worst seed; CV: standard deviation "
    "over absolute mean in the last rounds, twenty at most"
)


def rows_of(measures: Sequence[Measures]) -> list[Row]:
    """The cells of one family's table by column; columns without any value are left out."""
    return _table(columns_of(dict.fromkeys(round for row in measures for round in row.curve)), measures)


def columns_of(rounds: Iterable[int] = ()) -> dict[str, Callable[[Measures], str | None]]:
    """Name of a column to the text of its cell for a method.

    :param rounds: of the learning curve
    """
    return {
        "method": lambda row: row.method,
        "seeds": lambda row: str(len(row.seeds)),
        "F": lambda row: f"{row.F:.4g} ± {row.F_std:.3g}" if len(row.seeds) > 1 else f"{row.F:.4g}",
        "less the baseline's": lambda row: _difference(row),
        "speed-up": lambda row: _number(row.speed_up, ".2f"),
        "worst client": lambda row: f"{row.worst_client:.4g}",
        "stuck": lambda row: _number(row.stuck, ".2g"),
        "W": lambda row: f"{row.W:.4g}",
        "CV": lambda row: _number(row.CV, ".3f"),
        **{f"round {round}": partial(_at_round, round) for round in rounds},
        "broadcast": lambda row: _number(row.broadcast, ".4g"),
        "success": lambda row: _number(row.success, ".2f"),
        "up, down per round": lambda row: _sizes(row.bytes_up_per_round, row.bytes_down_per_round),
        "up, down offline": lambda row: _sizes(row.offline_bytes_up, row.offline_bytes_down) if row.offline_bytes_up else None,
        "s per round": lambda row: f"{row.seconds_per_round:.3g}",
        "paper F": lambda row: _number(row.paper_F, "g"),
    }


def overview_rows(tables: Tables, column: str) -> list[Row]:
    """One measure of all families: a row per family, a column per method."""
    methods = dict.fromkeys(row.method for measures in tables.families.values() for row in measures)
    cell = columns_of()[column]
    rows = []
    for family, measures in tables.families.items():
        cells = {row.method: cell(row) for row in measures}
        rows.append({"family": family, **{method: cells.get(method) or "-" for method in methods}})
    return rows


def aggregate_rows(aggregates: Sequence[Aggregate]) -> list[Row]:
    """The cells of the table over all families, by column."""
    families = dict.fromkeys(family for row in aggregates for family in row.scores)
    columns: dict[str, Callable[[Aggregate], str | None]] = {
        "method": lambda row: row.method,
        "runs": lambda row: str(row.n_runs),
        "IQM": lambda row: f"{row.iqm:.3f}",
        "95 % interval": lambda row: None if row.interval is None else "{:.3f} to {:.3f}".format(*row.interval),
        **{family: partial(_score, family) for family in families},
    }
    return _table(columns, aggregates)


def _table(columns: Mapping[str, Callable[[Any], str | None]], rows: Sequence[Any]) -> list[Row]:
    cells = {name: [cell(row) for row in rows] for name, cell in columns.items()}
    shown = {name: [value or "-" for value in values] for name, values in cells.items() if any(values)}
    return [dict(zip(shown, values, strict=True)) for values in zip(*shown.values(), strict=True)]


def _at_round(round: int, row: Measures) -> str | None:
    return _number(row.curve.get(round), ".4g")


def _score(family: str, row: Aggregate) -> str:
    return f"{row.scores[family]:.3f}"


def _sizes(up: float | None, down: float | None) -> str | None:
    return None if up is None or down is None else f"{format_size(up)}, {format_size(down)}"


def _difference(row: Measures) -> str | None:
    if row.difference is None:
        return None
    interval = "" if row.difference_interval is None else " ({:.3g} to {:.3g})".format(*row.difference_interval)
    return f"{row.difference:+.3g}{interval}"


def _number(value: float | None, form: str) -> str | None:
    return None if value is None else format(value, form)


def print_tables(tables: Tables) -> None:
    """On the terminal."""
    for title, rows in _titled(tables):
        print_rows(title, rows)
    print_notes(LEGEND, *tables.notes)


def print_rows(title: str, rows: Sequence[Row], *notes: str) -> None:
    """Print a table on the terminal; columns that do not fit follow below, with the first column repeated."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if Console().is_terminal else 160)
    for part, columns in enumerate(fitting(rows, console.width)):
        table = Table(title="" if part else title, title_justify="left")
        for name in columns:
            table.add_column(name, justify="left" if name == next(iter(rows[0])) else "right", no_wrap=True)
        for row in rows:
            table.add_row(*(row[name] for name in columns))
        console.print(table)
    print_notes(*notes)


def print_notes(*notes: str) -> None:
    """Print notes on the terminal, each on its own lines."""
    from rich.console import Console

    for note in notes:
        Console().print(note, highlight=False, soft_wrap=True)


def fitting(rows: Sequence[Row], width: int) -> list[list[str]]:
    """The columns in groups of at most ``width`` characters, each with the first column before it."""
    first, *others = rows[0]
    sizes = {name: 3 + max(len(name), *(len(row[name]) for row in rows)) for name in rows[0]}  # padding and a border
    groups: list[list[str]] = []
    left = 0
    for name in others:
        if sizes[name] > left:
            groups.append([first])
            left = width - 1 - sizes[first]
        groups[-1].append(name)
        left -= sizes[name]
    return groups


def _titled(tables: Tables) -> list[tuple[str, list[Row]]]:
    titled = [(f"{column} by family", overview_rows(tables, column)) for column in tables.overview if tables.families]
    titled += [(name, rows_of(measures)) for name, measures in tables.families.items()]
    if tables.aggregates:
        titled.append(("All families: normalised scores", aggregate_rows(tables.aggregates)))
    return titled


def markdown(tables: Tables) -> str:
    """Headings and tables; the notes below them."""
    lines: list[str] = []
    for title, rows in _titled(tables):
        lines += [f"## {title}", "", f"| {' | '.join(rows[0])} |", "|---" * len(rows[0]) + "|"]
        lines += [*(f"| {' | '.join(row.values())} |" for row in rows), ""]
    return "\n".join([*lines, *(f"* {note}" for note in tables.notes)]).rstrip() + "\n"


def latex(tables: Tables) -> str:
    """A ``table`` environment each, with the rules of booktabs; the notes as comments."""
    lines = ["% needs \\usepackage{booktabs}"]
    for title, rows in _titled(tables):
        lines += ["\\begin{table}", "\\centering", f"\\caption{{{_escaped(title)}}}"]
        lines += [f"\\begin{{tabular}}{{l{'r' * (len(rows[0]) - 1)}}}", "\\toprule", _latex_row(rows[0]), "\\midrule"]
        lines += [*(_latex_row(row.values()) for row in rows), "\\bottomrule", "\\end{tabular}", "\\end{table}", ""]
    return "\n".join([*lines, *(f"% {note}" for note in tables.notes)]).rstrip() + "\n"


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(map(_escaped, cells)) + " \\\\"


def _escaped(text: str) -> str:
    special = {"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "±": "$\\pm$"}
    escaped = "".join(special.get(letter, f"\\{letter}" if letter in "&%$#_{}" else letter) for letter in text)
    return re.sub(r"(?<![\w)])-(?=[\d.])", "$-$", escaped)


def as_json(tables: Tables) -> str:
    """Every number in full precision; a non-finite number is ``null``."""
    content = {
        "families": {name: [asdict(row) for row in measures] for name, measures in tables.families.items()},
        "aggregate": [asdict(row) for row in tables.aggregates],
        "notes": list(tables.notes),
    }
    return json.dumps(_finite(content), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_csv(tables: Tables) -> str:
    """The families' tables, one row per family and method, in full precision; without the aggregate."""
    records = []
    for name, measures in tables.families.items():
        for row in measures:
            record = {"results": name, **asdict(row), "seeds": " ".join(map(str, row.seeds))}
            curve = record.pop("curve")
            records.append({**record, **{f"round_{round}": value for round, value in curve.items()}})
    columns = dict.fromkeys(column for record in records for column in record)
    file = io.StringIO()
    writer = csv.DictWriter(file, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return file.getvalue()


#: Formats by the flag of the command.
WRITERS: dict[str, Callable[[Tables], str]] = {"markdown": markdown, "latex": latex, "json": as_json, "csv": as_csv}
