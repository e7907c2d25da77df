"""The console script ``fedguide``: its subcommands. Each imports its modules when it is called."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.settings.names import nearest

USAGE = """usage: fedguide COMMAND ...

  train      train a federation (the same as train.py)
  evaluate   evaluate a finished run's policies, client by client
  export     export clients' policies: Stable-Baselines3, TorchScript, torch.export, ONNX
  push       upload a run to the Hugging Face hub, without pickle, with a model card
  pull       download a run from the hub and check it
  benchmark  train methods on families with seeds, as resumable runs, and print tables of their results
  plot       draw figures of a benchmark's results or of runs: learning curves, bars, rollouts, transport plan, ...
  tune       search for an algorithm's hyperparameters with Optuna
  deploy     run a federation over a network: certificates, keys, server and clients
  dataset    make a Minari dataset for the offline stage from CSV or NPZ logs
  demo       train FedAvg and FedGuide on Bandit2D, with a picture

fedguide COMMAND --help shows a command's flags"""


@pipe_may_close
def main(argv: Sequence[str] | None = None) -> int:
    """Run a subcommand and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from sb3_fedguide import __version__

        print(__version__)
        return 0
    commands: dict[str, Callable[[Sequence[str]], int]] = {
        "train": _train,
        "evaluate": _evaluate,
        "export": _export,
        "push": _push,
        "pull": _pull,
        "benchmark": _benchmark,
        "plot": _plot,
        "tune": _tune,
        "deploy": _deploy,
        "dataset": _dataset,
        "demo": _demo,
    }
    if arguments[0] not in commands:
        print(f"fedguide: error: unknown command {arguments[0]!r}.{nearest(arguments[0], commands)} Known: "
              f"{', '.join(commands)}", file=sys.stderr)  # fmt: skip
        return 2
    return commands[arguments[0]](arguments[1:])


def _train(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.train import main

    return main(argv, prog="fedguide train")


def _evaluate(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.evaluate import main

    return main(argv)


def _export(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.export import main

    return main(argv)


def _push(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.push import main

    return main(argv)


def _pull(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.pull import main

    return main(argv)


def _benchmark(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.benchmark import main

    return main(argv)


def _plot(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.plot import main

    return main(argv)


def _tune(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.tune import main

    return main(argv)


def _deploy(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.deploy import main

    return main(argv)


def _dataset(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.dataset import main

    return main(argv)


def _demo(argv: Sequence[str]) -> int:
    from sb3_fedguide.cli.demo import main

    return main(argv)
