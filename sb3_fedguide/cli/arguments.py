"""The flags of ``train.py``: those of rl-baselines3-zoo, and a few for federations. Imports nothing heavy."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from sb3_fedguide.engines import ENGINES
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.evaluation import EVAL_EPISODES, EVAL_FREQ

#: Libraries for ``--track``; each is a package of that name and an extra of this package.
TRACKERS = ("trackio", "wandb")
TRACK_PROJECT = "sb3-fedguide"


class OneLineParser(argparse.ArgumentParser):
    """Errors are one message on one line, with exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")

    def parse_strictly(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Parse, and name the nearest flag for an unknown one."""
        arguments, unknown = self.parse_known_args(argv)
        if unknown:
            from sb3_fedguide.settings.names import nearest

            flags = [option for action in self._actions for option in action.option_strings]
            self.error(f"unknown argument {unknown[0]!r}.{nearest(unknown[0].split('=')[0], flags)}")
        return arguments


def train_parser(prog: str) -> OneLineParser:
    """Parser of the training command."""
    parser = OneLineParser(
        prog=prog,
        allow_abbrev=False,
        description="Train a federation: every client of a family of environments, on this machine.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    flag = parser.add_argument
    flag("--algo", default="fedguide", metavar="ALGO", help=", ".join(ALGORITHMS))
    flag("--env", metavar="FAMILY", help="family of client environments, e.g. HopperHard; or Gymnasium ids, one per client: "
         "Arm-v0,Arm-v1,Arm-v2; or one id with --client-kwargs")  # fmt: skip
    flag(
        "--client-kwargs",
        metavar="FILE",
        help="YAML list of keyword arguments of Gymnasium's environments, one entry per client",
    )
    flag("--env-kwargs", nargs="+", action="extend", default=[], metavar="KEY:VALUE", help="keyword arguments for all clients")
    flag("--gym-packages", nargs="+", action="extend", default=[], metavar="MODULE", help="modules to import first; they "
         "register your own algorithms or environments")  # fmt: skip
    flag("--metadata", metavar="FILE", help="metadata file of your own family (python -m fed_envs.metadata generate)")
    flag("--dataset", metavar="ID", help="Minari dataset, id or path, instead of automatically collected data; '{client}' "
         "in it stands for the client's number")  # fmt: skip
    flag("-n", "--n-timesteps", type=int, metavar="N", help="environment steps of all clients together, instead of --rounds")
    flag("--rounds", type=int, metavar="N", help="communication rounds; by default those of the configuration")
    flag("--n-envs-per-client", type=int, metavar="N", help="environments per client; by default those of the configuration")
    flag("-conf", "--conf-file", default="tuned", metavar="CONF", help="hyperparameters: tuned, paper, quick, or a YAML file")
    flag("-params", "--hyperparams", nargs="+", action="extend", default=[], metavar="KEY:VALUE",
         help="hyperparameters to overwrite, e.g. learning_rate:1e-4 policy_kwargs.net_arch:[64,64] "
         "pretraining.dice_updates:1000")  # fmt: skip
    flag("--seed", type=int, default=0, help="random seed of the whole federation; negative: drawn at random")
    flag("-f", "--log-folder", default="logs", metavar="DIR", help="runs are written to DIR/ALGO/FAMILY_<number>")
    flag("-tb", "--tensorboard-log", metavar="DIR", help="TensorBoard events to DIR/FAMILY/ALGO_<number>; by default to "
         "the run's folder")  # fmt: skip
    flag("--track", choices=TRACKERS, help="log to trackio or Weights & Biases as well, with TensorBoard's keys")
    flag("--track-project", metavar="NAME", help=f"project there; by default {TRACK_PROJECT}")
    flag("--cache-dir", metavar="DIR", help="folder for results of the offline stage; by default $FEDGUIDE_CACHE or "
         "~/.cache/fedguide")  # fmt: skip
    flag("--eval-freq", type=int, default=EVAL_FREQ, metavar="ROUNDS", help="rounds between evaluations; each of the last "
         "twenty rounds is evaluated")  # fmt: skip
    flag("--eval-episodes", type=int, default=EVAL_EPISODES, metavar="N", help="evaluation episodes per client")
    flag("--eval-average", action="store_true", help="also evaluate the average of the clients' policies if the method "
         "itself sends no policy")  # fmt: skip
    flag("--no-eval", action="store_true", help="do not evaluate")
    flag("--save-freq", type=int, default=10, metavar="ROUNDS", help="rounds between checkpoints; 0: none")
    flag("--resume", metavar="RUN", help="resume the run in this folder, with its own settings; --rounds or -n makes it "
         "longer")  # fmt: skip
    flag("-i", "--trained-agent", metavar="RUN", help="start from a run's parameters: its folder, or its parameters.npz")
    flag("--picture-freq", type=int, default=20, metavar="ROUNDS", help="rounds between pictures in TensorBoard; 0: none")
    flag("-P", "--progress", action="store_true", help="progress bars")
    flag("--device", default="cpu", help="PyTorch device, e.g. cpu or cuda")
    flag("--num-threads", type=int, default=1, metavar="N", help="threads that step the simulators (PyTorch takes one: small "
         "networks gain nothing from more)")  # fmt: skip
    flag("--engine", default="lockstep", choices=ENGINES, help="where the clients train: all in "
         "this process, in other processes, or in Ray actors; results are the same")  # fmt: skip
    flag("--num-actors", type=int, default=2, metavar="K", help="groups of clients that train at the same time, with "
         "processes or ray")  # fmt: skip
    flag("--ray-address", metavar="ADDRESS", help="a running Ray cluster, e.g. auto or 10.0.0.1:6379; by default "
         "one is started")  # fmt: skip
    flag("--delays", metavar="SPEC", help="simulate stragglers and dropouts: sync, deadline or async with settings, e.g. "
         "async:median=60,spread=0.8,dropout=0.1,tick=30, or a YAML file of them")  # fmt: skip
    flag("--verbose", type=int, default=1, choices=(0, 1, 2), help="0: only warnings and errors; 1: each round's log (not "
         "with progress bars); 2: also with progress bars")  # fmt: skip
    return parser


def parse_train(argv: Sequence[str] | None, prog: str) -> argparse.Namespace:
    """Parse, and refuse errors that the flags alone show."""
    parser = train_parser(prog)
    arguments = parser.parse_strictly(argv)
    for problem in _problems(arguments):
        parser.error(problem)
    return arguments


def _problems(arguments: Any) -> list[str]:
    found = []
    if arguments.env is None and arguments.metadata is None and arguments.resume is None:
        found.append("give the clients' environments with --env FAMILY, or --metadata FILE")
    if arguments.n_timesteps is not None and arguments.rounds is not None:
        found.append("-n/--n-timesteps and --rounds both set the length; give one of them")
    for name in ("n_timesteps", "rounds", "n_envs_per_client", "eval_freq", "eval_episodes", "num_threads", "num_actors"):
        value = getattr(arguments, name)
        if value is not None and value < 1:
            found.append(f"--{name.replace('_', '-')} must be at least 1, not {value}")
        if value is not None and value >= 2**63:
            found.append(f"--{name.replace('_', '-')} must be below 2^63, but it has {len(str(value))} digits")
    if arguments.save_freq < 0:
        found.append(f"--save-freq must not be negative, not {arguments.save_freq}; 0 writes no checkpoints")
    if arguments.eval_average and arguments.no_eval:
        found.append("--eval-average and --no-eval contradict each other; give one of them")
    if arguments.engine != "lockstep" and arguments.device not in ("cpu", "auto"):
        found.append(f"--engine {arguments.engine} trains on CPUs; leave out --device {arguments.device}, or the engine")
    if arguments.ray_address is not None and arguments.engine != "ray":
        found.append("--ray-address is for --engine ray")
    if arguments.track_project is not None and arguments.track is None and arguments.resume is None:
        found.append("--track-project is for --track trackio or --track wandb")
    if arguments.track_project is not None and not re.fullmatch(r"[\w.-]+", arguments.track_project):
        found.append(f"--track-project {arguments.track_project!r} is not a name: use only letters, digits and . _ -")
    if arguments.picture_freq < 0:
        found.append(f"--picture-freq must not be negative, not {arguments.picture_freq}; 0 draws no pictures")
    if arguments.seed >= 2**31:
        found.append(f"--seed must be below 2^31, not {arguments.seed}")
    return found
