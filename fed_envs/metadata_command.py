"""The command line of ``python -m fed_envs.metadata``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from fed_envs.generation import generate_family
from fed_envs.metadata import Family, load_family
from fed_envs.registration import FAMILIES


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m fed_envs.metadata", description="Metadata files of client families.")
    commands = parser.add_subparsers(dest="command", required=True)
    generate = commands.add_parser("generate", help="make a new family from the presets of a shipped one")
    generate.add_argument("--family", required=True, metavar="NAME", help=f"whose presets: {', '.join(FAMILIES)}")
    generate.add_argument("--clients", type=int, required=True, metavar="N", help="number of clients")
    generate.add_argument("--seed", type=int, default=0, help="seed of the clients' parameters (default: 0)")
    generate.add_argument("--name", help="the new family's name (default: FAMILY_N_seedSEED)")
    generate.add_argument("-o", "--output", metavar="FILE", help="where to write it (default: the terminal)")
    for name, text in (("show", "print a family's clients as a table"), ("validate", "check metadata files")):
        command = commands.add_parser(name, help=text)
        command.add_argument("families", nargs="+", metavar="FILE", help="metadata files, or names of shipped families")
    plot = commands.add_parser("plot", help="draw how clients differ, and how far a Hard family reaches beyond its main one")
    plot.add_argument("families", nargs="+", metavar="FILE", help="metadata files, or names of shipped families")
    plot.add_argument("-o", "--output", metavar="DIR", default="figures", help="folder of the pictures (default: figures)")
    return parser


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.5g}"
    return ", ".join(map(_cell, value)) if isinstance(value, tuple) else str(value)


def table(family: Family) -> str:
    """A family's clients as a plain-text table, one line per client."""
    rows = [["client", *family.clients[0].parameters()]]
    rows += [[str(client.client), *map(_cell, client.parameters().values())] for client in family.clients]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    head = f"{family.name}: {family.n_clients} clients on {family.backbone}, {family.max_episode_steps} steps an episode"
    return "\n".join([head, family.description, f"content hash {family.content_hash}", "", *lines])


def _plot(families: Sequence[Family], folder: Path) -> None:
    """Write each family's heat map, and the ranges of every main family beside its Hard one, as PNG and PDF."""
    from fed_envs import metadata_figures

    figures = {f"heterogeneity-{family.name}": metadata_figures.heterogeneity(family) for family in families}
    shown = {family.name: family for family in families}
    for name in dict.fromkeys(family.name.removesuffix("Hard") for family in families):
        pair = [shown.get(own) or load_family(own) for own in (name, f"{name}Hard") if own in shown or own in FAMILIES]
        if len(pair) == 2:
            figures[f"ranges-{name}"] = metadata_figures.ranges(pair)
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        if figure is None:
            print(f"left out {name}: no number differs between the clients")
            continue
        for kind in ("png", "pdf"):
            figure.savefig(folder / f"{name}.{kind}", dpi=180)
        print(f"{folder / name}.png, .pdf")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; errors are one message on stderr and exit code 2, as argparse has it."""
    options = _parser().parse_args(arguments)
    try:
        if options.command == "generate":
            family = generate_family(options.family, options.clients, options.seed, options.name)
            if options.output is None:
                print(json.dumps(family.to_dict(), indent=2))
            else:
                family.dump(options.output)
                print(f"{options.output}: {family.name}, {family.n_clients} clients")
        elif options.command == "plot":
            _plot([load_family(source) for source in options.families], Path(options.output))
        else:
            for number, source in enumerate(options.families):
                family = load_family(source)
                if options.command == "validate":
                    print(f"{source}: valid, {family.name} with {family.n_clients} clients")
                else:
                    print("\n" * (number > 0) + table(family))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0
