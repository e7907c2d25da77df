"""Command lines in pages and cards, parsed as the commands themselves do."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from fed_envs import FAMILIES, load_family
from sb3_fedguide.cli import benchmark_arguments, deploy, evaluate, export, pull, push
from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.main import USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.config import parse_params, resolve

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def blocks(text: str, language: str) -> list[str]:
    """What stands between fences of a language, ``""`` for commands."""
    fences = re.findall(r"^```([^\n]*)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [body for tag, body in fences if tag.strip() == language]


def commands(text: str) -> list[list[str]]:
    """The command lines of this package in a page, in words, without comments."""
    found = []
    for block in blocks(text, ""):
        for line in block.replace("\\\n", " ").splitlines():
            words = (
                shlex.split(line.removeprefix("$ "), comments=True)
                if "#" in line or "fedguide" in line or "py" in line
                else []
            )
            words = words[1:] if words[:1] and words[0].endswith("/python") else words
            words = ["fedguide", *words[1:]] if words[:1] and words[0].endswith("/bin/fedguide") else words
            words = ["python", *words[1:]] if words[:1] == ["python3"] else words
            if words[:1] == ["fedguide"] or words[:1] == ["python"]:
                found.append([word for word in words if word not in ("[...]",)])
    return found


def check_command(words: list[str]) -> None:
    """Parse a command line, and resolve the hyperparameters that it asks for.

    :raises SystemExit: where a parser refuses it
    """
    program, *arguments = words
    if program == "python":
        if arguments[0] == "-m" and arguments[1] == "fed_envs.metadata":
            from fed_envs.metadata_command import _parser

            _parser().parse_args(arguments[2:])
            return
        assert (DOCS / "examples" / arguments[0]).exists() or (ROOT / arguments[0]).exists(), f"there is no {arguments[0]}"
        if not arguments[0].endswith("train.py"):
            return
        command, arguments = "train", arguments[1:]
    else:
        command, *arguments = arguments
    if arguments[-1:] == ["--help"] or command == "--version":
        return
    assert re.search(rf"^  {command} ", USAGE, re.MULTILINE), f"fedguide has no command {command}"
    if command == "train":
        options = parse_train(arguments, "train.py")
        if options.env in FAMILIES and options.algo in ALGORITHMS and options.conf_file in ("tuned", "paper", "quick"):
            resolve(options.algo, load_family(options.env), options.conf_file, overrides=parse_params(options.hyperparams))
    elif command == "benchmark":
        options = benchmark_arguments.parse_benchmark(arguments, "fedguide benchmark")
        for name in set(options.algos or ()) & set(ALGORITHMS):
            resolve(name, load_family(options.envs[0]), overrides=parse_params(options.hyperparams))
    elif command in (commands := {"evaluate": evaluate, "export": export, "push": push, "pull": pull}):
        commands[command]._parser(command).parse_strictly(arguments)
    elif command == "deploy":
        deploy._parser().parse_strictly(arguments)
    elif command == "dataset":
        from sb3_fedguide.cli import dataset
        from sb3_fedguide.offline.make_dataset import COLUMNS

        dataset._parser(command, COLUMNS).parse_strictly(arguments)
