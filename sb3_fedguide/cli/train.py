"""The training command: check everything, then write a run folder, train, evaluate and report.

Nothing is created on disk, and neither PyTorch nor the simulator is imported, before the flags are known to be sound.
"""

from __future__ import annotations

import argparse
import importlib
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.algorithms import ALGORITHMS
from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.names import check_names

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.cli.config import Config
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

EXIT_USAGE = 2
EXIT_INTERRUPTED = 130
ID_PREFIX, ID_SUFFIX = "fed_envs/", "-v0"


def main(argv: Sequence[str] | None = None, prog: str = "train.py") -> int:
    """Run the command.

    :return: the exit code: 0, 2 for wrong input, 130 after an interrupt
    """
    arguments = parse_train(argv, prog)
    command = shlex.join(sys.orig_argv if argv is None else [prog, *argv])
    try:
        import_packages(arguments.gym_packages)
        family = find_family(arguments)
        _check_before_imports(arguments)
        run = prepare(arguments, family, command)
    except ValueError as error:
        print(f"{prog}: error: {_one_message(error)}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the run began", file=sys.stderr)
        return EXIT_INTERRUPTED
    return run()


def import_packages(modules: Sequence[str]) -> None:
    """Import the user's modules, from the current folder too.

    :raises ValueError: for one that cannot be imported
    """
    if modules and "" not in sys.path:
        sys.path.insert(0, "")
    for module in modules:
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ValueError(f"--gym-packages {module}: {error}") from None


def find_family(arguments: argparse.Namespace) -> Family:
    """The clients that ``--env`` or ``--metadata`` mean.

    :raises ValueError: for an unknown family, a wrong file, or two that do not belong together
    """
    import fed_envs

    named = None
    if arguments.env is not None:
        name = arguments.env
        if name.startswith(ID_PREFIX) and name.endswith(ID_SUFFIX):
            name = name[len(ID_PREFIX) : -len(ID_SUFFIX)]
        check_names([name], fed_envs.FAMILIES, "environment")
        named = fed_envs.load_family(name)
    if arguments.metadata is None:
        assert named is not None  # one of the two is required
        return named
    if not Path(arguments.metadata).is_file():
        raise ValueError(f"--metadata: there is no file {arguments.metadata}")
    family = fed_envs.load_family(Path(arguments.metadata).absolute())
    if named is not None and named.backbone != family.backbone:
        raise ValueError(
            f"--env {named.name} and --metadata {arguments.metadata} do not belong together: the file's clients are "
            f"{family.backbone}, not {named.backbone}; leave --env out to take the settings of the file's own family"
        )
    return family


def _check_before_imports(arguments: argparse.Namespace) -> None:
    from sb3_fedguide.cli.config import config_path, parse_params, read_config
    from sb3_fedguide.cli.run_folder import check_log_folder

    check_names([arguments.algo], ALGORITHMS, "algorithm")
    check_log_folder(Path(arguments.log_folder))
    if arguments.tensorboard_log is not None:
        check_log_folder(Path(arguments.tensorboard_log))
    read_config(config_path(arguments.conf_file, arguments.algo))
    parse_params(arguments.hyperparams)


def overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """Hyperparameters given on the command line, flags included.

    :raises ValueError: where two of them say the same thing
    """
    from sb3_fedguide.cli.config import parse_params

    given = parse_params(arguments.hyperparams)
    flags = {
        "n_rounds": ("--rounds", arguments.rounds),
        "n_envs_per_client": ("--n-envs-per-client", arguments.n_envs_per_client),
        "pretraining.dataset": ("--dataset", arguments.dataset),
    }
    for name, (flag, value) in flags.items():
        if value is not None:
            if name in given:
                raise ValueError(f"{flag} and -params {name} set the same thing; give one of them")
            given[name] = value
    if arguments.n_timesteps is not None and "n_rounds" in given:
        raise ValueError("-n/--n-timesteps and -params n_rounds both say how long to train; give one of them")
    return given


class Run:
    """A run whose inputs are all known to be sound; calling it trains."""

    def __init__(
        self,
        arguments: argparse.Namespace,
        command: str,
        config: Config,
        family: Family,
        model: FederatedPPO | FederatedDDPG,
    ) -> None:
        self.arguments, self.command, self.config, self.family, self.model = arguments, command, config, family, model

    def __call__(self) -> int:
        from sb3_fedguide.cli.report import print_summary
        from sb3_fedguide.cli.run_folder import create_run_folder, write_deployed, write_json

        arguments, model = self.arguments, self.model
        folder = create_run_folder(Path(arguments.log_folder), arguments.algo, self.family.name)
        self._record_inputs(folder)
        self._set_logger(folder)
        if arguments.verbose:
            print(f"{arguments.algo} on {self.family.name}: {model.n_clients} clients, {self.config.n_rounds} rounds, "
                  f"writing to {folder}", flush=True)  # fmt: skip
        exit_code = 0
        try:
            summary = self._train(folder)
        except KeyboardInterrupt:
            print(f"\ninterrupted in round {model.round + 1}; what there is stays in {folder}", file=sys.stderr)
            summary, exit_code = self._summary(), EXIT_INTERRUPTED
        except OfflineStageError as error:
            print(f"error in the offline stage: {_one_message(error)}", file=sys.stderr)
            return EXIT_USAGE
        finally:
            model.logger.close()
        if model.round > 0:
            model.save(folder / "model.zip")
            if deployed := self._deployed.replaced():
                write_deployed(folder, deployed)
        write_json(folder / "summary.json", summary)
        if arguments.verbose:
            print_summary(summary, str(folder))
        return exit_code

    def _record_inputs(self, folder: Path) -> None:
        from sb3_fedguide.cli.run_folder import versions, write_json, write_text, write_yaml

        write_yaml(folder / "config.yml", self.config.values)
        write_yaml(folder / "args.yml", {**vars(self.arguments), "seed": self.model.seed})
        write_text(folder / "command.txt", self.command + "\n")
        write_json(folder / "versions.json", versions())
        self.family.dump(folder / "metadata.json")
        write_text(folder / "metadata.sha256", self.family.content_hash + "\n")

    def _set_logger(self, folder: Path) -> None:
        from stable_baselines3.common.logger import HumanOutputFormat, KVWriter, Logger, TensorBoardOutputFormat

        arguments = self.arguments
        events = folder / "tb"
        if arguments.tensorboard_log is not None:
            number = folder.name.rsplit("_", 1)[1]
            events = Path(arguments.tensorboard_log) / self.family.name / f"{arguments.algo}_{number}"
        loud = arguments.verbose == 2 or (arguments.verbose == 1 and not arguments.progress)
        outputs: list[KVWriter] = [TensorBoardOutputFormat(str(events))]
        if loud:
            outputs.append(HumanOutputFormat(sys.stdout))
        self.model.set_logger(Logger(str(events), outputs))

    def _train(self, folder: Path) -> dict[str, Any]:
        from sb3_fedguide.cli.recorder import CostCallback, DeployedCallback, RunEvalCallback

        arguments, model = self.arguments, self.model
        self._started, self._pretraining_seconds = time.perf_counter(), 0.0
        self._costs, self._deployed, self._evaluation = CostCallback(), DeployedCallback(), None
        if not arguments.no_eval:
            self._evaluation = RunEvalCallback(
                self.config.n_rounds, arguments.eval_freq, arguments.eval_episodes, folder / "evaluations.csv"
            )
        try:
            model.pretrain(progress_bar=arguments.progress)
        except ValueError as error:
            raise OfflineStageError(str(error)) from error
        self._pretraining_seconds = time.perf_counter() - self._started
        model.learn(
            self.config.n_rounds * model.rollout_size * model.n_participants,
            [callback for callback in (self._evaluation, self._costs, self._deployed) if callback is not None],
            progress_bar=arguments.progress,
        )
        return self._summary()

    def _summary(self) -> dict[str, Any]:
        from sb3_fedguide.cli.report import summarize

        return summarize(
            self.model,
            self._costs,
            self._evaluation,
            self._pretraining_seconds,
            time.perf_counter() - self._started,
            algo=self.arguments.algo,
            env=self.family.name,
            conf_file=self.arguments.conf_file,
            metadata_hash=self.family.content_hash,
            n_rounds=self.config.n_rounds,
        )


class OfflineStageError(Exception):
    """Something in the offline stage that the user can put right, such as a dataset that cannot be read."""


def prepare(arguments: argparse.Namespace, family: Family, command: str) -> Run:
    """Resolve the hyperparameters and construct the algorithm; nothing is written yet.

    :raises ValueError: for anything that a user can put right
    """
    from sb3_fedguide.cli.config import resolve

    given = overrides(arguments)
    entry = None if arguments.env is None else arguments.env.removeprefix(ID_PREFIX).removesuffix(ID_SUFFIX)
    config = resolve(arguments.algo, family, arguments.conf_file, entry, given, arguments.n_timesteps)
    if config.values["pretraining"]["dataset"] is not None:
        _check_dataset(config.values["pretraining"]["dataset"], family)

    import torch as th

    _check_device(arguments.device)
    th.set_num_threads(arguments.num_threads)
    model = config.make(
        family,
        seed=arguments.seed if arguments.seed >= 0 else None,
        device=arguments.device,
        cache_dir=arguments.cache_dir,
        verbose=0,
    )
    return Run(arguments, command, config, family, model)


def _check_dataset(dataset: str, family: Family) -> None:
    from sb3_fedguide.offline.minari_io import check_spaces, find_dataset

    for client in range(family.n_clients):
        env = family.make(client)
        check_spaces(find_dataset(dataset.replace("{client}", str(client))), env.observation_space, env.action_space)
        env.close()


def _check_device(device: str) -> None:
    import torch as th

    if device == "auto":
        return
    try:
        kind = th.device(device).type
    except RuntimeError:
        raise ValueError(f"unknown device {device!r}; use cpu, cuda, cuda:<number>, mps or auto") from None
    available = {"cpu": True, "cuda": th.cuda.is_available(), "mps": th.backends.mps.is_available()}
    if not available.get(kind, False):
        raise ValueError(f"device {device!r} is not available on this machine; use --device cpu")


def _one_message(error: Exception) -> str:
    return "\n  ".join(str(error).splitlines())
