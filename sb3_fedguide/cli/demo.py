"""The demonstration: FedAvg and FedGuide on Bandit2D with the zoo's settings, and a picture of their policies."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.output import pipe_may_close

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.benchmark.bandit2d import MethodResult
    from sb3_fedguide.common.federated_ppo import FederatedPPO
    from sb3_fedguide.settings.config import Config

#: Trained in this order; Local is drawn only as a learning curve.
METHODS = {"Local": "local", "FedAvg": "fedavg", "FedGuide": "fedguide"}
DRAWN = ("FedAvg", "FedGuide")


@pipe_may_close
def main(argv: Sequence[str] | None = None) -> int:
    """Train both, print the measures, write the picture and the numbers."""
    parser = OneLineParser(prog="fedguide demo", description=__doc__)
    parser.add_argument("-f", "--folder", default="runs/demo", metavar="DIR", help="folder of the picture")
    parser.add_argument("-conf", "--conf-file", default="tuned", metavar="CONF", help="tuned, paper, quick, or a YAML file")
    parser.add_argument("--rounds", type=int, metavar="N", help="communication rounds, by default those of the configuration")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-P", "--progress", action="store_true", help="progress bars")
    arguments = parser.parse_args(argv)
    started = time.perf_counter()
    folder = Path(arguments.folder)
    try:
        from sb3_fedguide.cli.run_folder import check_log_folder

        if arguments.rounds is not None and arguments.rounds < 1:
            raise ValueError(f"--rounds must be at least 1, not {arguments.rounds}")
        if not 0 <= arguments.seed < 2**31:
            raise ValueError(f"--seed must lie in [0, 2^31), not {arguments.seed}")
        check_log_folder(folder)
        configs = _configs(arguments.conf_file, arguments.rounds)
    except ValueError as error:
        parser.error(str(error))
    try:
        _run(folder, configs, arguments.seed, arguments.progress)
    except KeyboardInterrupt:
        print("\ninterrupted; nothing was drawn")
        return 130
    print(f"done in {time.perf_counter() - started:.0f} s")
    return 0


def _configs(conf_file: str, rounds: int | None) -> dict[str, Config]:
    from fed_envs import load_family
    from sb3_fedguide.settings.config import resolve

    family, overrides = load_family("Bandit2D"), {} if rounds is None else {"n_rounds": rounds}
    return {name: resolve(algo, family, conf_file, overrides=overrides) for name, algo in METHODS.items()}


def _run(folder: Path, configs: dict[str, Config], seed: int, progress: bool) -> None:
    import torch as th
    from rich.console import Console
    from rich.table import Table

    from fed_envs import load_family
    from sb3_fedguide.benchmark.bandit2d import priors
    from sb3_fedguide.benchmark.figures.bandit2d import draw, grid
    from sb3_fedguide.cli.run_folder import write_json
    from sb3_fedguide.offline.datasets import client_datasets

    th.set_num_threads(1)
    family = load_family("Bandit2D")
    trained = {name: _train(name, config, family, seed, progress) for name, config in configs.items()}
    results = [result for _, result in trained.values()]
    guided = trained["FedGuide"][0]
    data = client_datasets(family, guided.pretraining_config.dataset_size, seed, guided.cache_dir)
    folder.mkdir(parents=True, exist_ok=True)
    picture = folder / "bandit2d.png"
    draw(results, DRAWN, priors(guided, grid()), [rows.actions for rows in data], picture)  # type: ignore[arg-type]
    write_json(folder / "bandit2d.json", {result.name: {**result.measures(), "curve": result.curve} for result in results})

    table = Table(title="Bandit2D: four clients, four peaks", title_justify="left")
    for column in ("", "F", "peaks kept", r"E_pi\[r]"):
        table.add_column(column, justify="right" if column else "left")
    for result in results:
        values = result.measures()
        table.add_row(result.name, f"{values['F']:.3f}", f"{values['peaks_kept']} of 4", f"{values['expected_reward']:.3f}")
    console = Console(width=None if Console().is_terminal else 100)
    console.print(table)
    console.print(f"picture {picture}", highlight=False, soft_wrap=True)


def _train(name: str, config: Config, family: Family, seed: int, progress: bool) -> tuple[FederatedPPO, MethodResult]:
    from sb3_fedguide.benchmark.bandit2d import MethodResult, PolicySnapshot, policies
    from sb3_fedguide.cli.recorder import RunEvalCallback
    from sb3_fedguide.common.federated_ppo import FederatedPPO

    model = config.make(family, seed=seed)
    assert isinstance(model, FederatedPPO)
    evaluation, snapshot = RunEvalCallback(config.n_rounds, eval_freq=1), PolicySnapshot()
    total = config.n_rounds * model.rollout_size * model.n_clients
    model.learn(total, [evaluation, snapshot], progress_bar=progress)
    shared = policies(model) if model.sends_policy(model.round) else None
    final = evaluation.last["deployed"].average
    return model, MethodResult(name, snapshot.deployed, final, evaluation.curves["deployed"], shared)
