"""The training command: check everything, then write a run folder, train, evaluate and report.

Nothing is created on disk, and neither PyTorch nor the simulator is imported, before the flags are known to be sound.
"""

from __future__ import annotations

import argparse
import importlib.util
import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.gymnasium_ids import is_registered, registered_family
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.resume import (
    check_length,
    finished_rounds,
    given_flags,
    load_checkpoint,
    read_arguments,
    read_settings,
    with_length,
)
from sb3_fedguide.cli.run import Run, one_message
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO
    from sb3_fedguide.settings.config import Config

EXIT_INTERRUPTED = 130
PACKAGE = Path(__file__).parents[1]
ID_PREFIX, ID_SUFFIX = "fed_envs/", "-v0"


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "train.py") -> int:
    """Run the command.

    :return: the exit code: 0, 1 where a file could not be written or a client broke, 2 for wrong input, 130 after an
        interrupt (SIGINT), 143 after SIGTERM, 129 after SIGHUP
    """
    arguments = parse_train(argv, prog)
    command = shlex.join(sys.orig_argv if argv is None else [prog, *argv])
    try:
        if arguments.resume is not None:
            run = resume(Path(arguments.resume), given_flags(argv, prog), command, prog)
        else:
            import_packages(arguments.gym_packages)
            family = find_family(arguments)
            check_before_imports(arguments)
            run = prepare(arguments, family, command)
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the run began", file=sys.stderr)
        return EXIT_INTERRUPTED
    from fed_envs.faults import ClientError
    from sb3_fedguide.engines.engine import EngineError

    try:
        with _no_reports_of_threads(), _short_warnings(prog):
            return run()
    except ClientError as error:
        print(f"{prog}: error: {one_message(error)}; what was written before stays", file=sys.stderr)
        return EXIT_FAILED
    except EngineError as error:
        print(f"{prog}: error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except BrokenPipeError:
        raise
    except OSError as error:  # a full disk, or a folder that is read-only
        where = error.filename or arguments.log_folder
        print(f"{prog}: error: {where}: {error.strerror or error}; what was written before stays", file=sys.stderr)
        return EXIT_FAILED


@contextmanager
def _no_reports_of_threads() -> Iterator[None]:
    """TensorBoard writes in a thread of its own. What fails there is raised here by its next call; once is enough."""
    before = threading.excepthook
    threading.excepthook = lambda failure: None if isinstance(failure.exc_value, OSError) else before(failure)
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def _short_warnings(prog: str) -> Iterator[None]:
    """Warnings of this package are for the user: without the line of code that Python shows with them."""
    before = warnings.formatwarning

    def format_warning(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if Path(filename).is_relative_to(PACKAGE):
            return f"{prog}: warning: {message}\n"
        return before(message, category, filename, lineno, line)

    warnings.formatwarning = format_warning
    try:
        yield
    finally:
        warnings.formatwarning = before


def resume(folder: Path, given: dict[str, Any], command: str, prog: str) -> Callable[[], int]:
    """What goes on with the run in ``folder``, and holds it until then.

    :param given: the flags on the command line
    :raises ValueError: where it cannot go on
    """
    arguments = read_arguments(folder, given, prog)
    check_tracker(arguments.track)
    import_packages(arguments.gym_packages)
    config, family = read_settings(folder, arguments.algo)
    config = with_length(config, family, given)
    from sb3_fedguide.cli.run_folder import exclusive

    with ExitStack() as stack:
        stack.enter_context(exclusive(folder))
        if (rounds := finished_rounds(folder)) is not None:
            check_length(folder, config, rounds)
            if config.n_rounds == rounds:
                print(f"the run in {folder} is finished: it had its {rounds} rounds")
                return lambda: 0
        run = Run(arguments, command, config, family, make_model(arguments, config, family), folder)
        if load_checkpoint(folder, run.model.resume, prog):
            check_length(folder, config, run.model.round)
        run.lock = stack.pop_all()
    return run


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
        ids = name.split(",")
        if name in fed_envs.FAMILIES or not (len(ids) > 1 or is_registered(name) or arguments.client_kwargs):
            check_names([name], fed_envs.FAMILIES, "environment")
            named = fed_envs.load_family(name)
        else:
            named = registered_family(ids, arguments.client_kwargs, arguments.env_kwargs)
    if (arguments.client_kwargs or arguments.env_kwargs) and (named is None or named.world != "gymnasium"):
        raise ValueError("--client-kwargs and --env-kwargs are for the ids of registered environments, --env Pendulum-v1")
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


def check_before_imports(arguments: argparse.Namespace) -> None:
    """What the flags and the files that they name already show, without PyTorch and the simulator.

    :raises ValueError: for what is wrong
    """
    from sb3_fedguide.cli.delays import read_delays
    from sb3_fedguide.cli.run_folder import check_log_folder, parameter_file
    from sb3_fedguide.offline.cache import cache_folder, check_cache_folder
    from sb3_fedguide.settings.config import config_path, parse_params, read_config

    check_names([arguments.algo], ALGORITHMS, "algorithm")
    if arguments.engine == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError("--engine ray needs Ray: pip install 'sb3-fedguide[ray]'")
    check_tracker(arguments.track)
    check_log_folder(Path(arguments.log_folder))
    if arguments.tensorboard_log is not None:
        check_log_folder(Path(arguments.tensorboard_log))
    check_cache_folder(cache_folder(arguments.cache_dir))
    read_config(config_path(arguments.conf_file, arguments.algo))
    parse_params(arguments.hyperparams)
    if arguments.trained_agent is not None:
        arguments.trained_agent = str(parameter_file(arguments.trained_agent))
    if arguments.delays is not None:
        arguments.delays = str(read_delays(arguments.delays))  # the run's own, should a file change


def check_tracker(name: str | None) -> None:
    """:raises ValueError: if the package that ``--track`` needs is missing"""
    if name is not None and importlib.util.find_spec(name) is None:
        raise ValueError(f"--track {name} needs the package {name}: pip install 'sb3-fedguide[{name}]'")


def overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """Hyperparameters given on the command line, flags included.

    :raises ValueError: where two of them say the same thing
    """
    from sb3_fedguide.settings.config import parse_params

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


def settings_entry(arguments: argparse.Namespace) -> str | None:
    """The entry of a configuration file that ``--env`` asks for; ``None`` for that of the family."""
    return None if arguments.env is None else arguments.env.removeprefix(ID_PREFIX).removesuffix(ID_SUFFIX)


def resolved(arguments: argparse.Namespace, family: Family) -> Config:
    """The hyperparameters that the flags ask for.

    :raises ValueError: for anything that a user can put right
    """
    from sb3_fedguide.settings.config import resolve

    given, entry = overrides(arguments), settings_entry(arguments)
    return resolve(arguments.algo, family, arguments.conf_file, entry, given, arguments.n_timesteps)


def prepare(arguments: argparse.Namespace, family: Family, command: str) -> Run:
    """Resolve the hyperparameters and construct the algorithm; nothing is written yet.

    :raises ValueError: for anything that a user can put right
    """
    config = resolved(arguments, family)
    if config.values["pretraining"]["dataset"] is not None:
        _check_dataset(config.values["pretraining"]["dataset"], family)
    model = make_model(arguments, config, family)
    model.check_offline_data()
    return Run(arguments, command, config, family, model)


def make_model(arguments: argparse.Namespace, config: Config, family: Family) -> FederatedPPO | FederatedDDPG:
    """Construct the algorithm.

    :raises ValueError: where the settings do not fit together
    """
    import torch as th

    from sb3_fedguide.cli.delays import read_delays

    _check_device(arguments.device)
    th.set_num_threads(1)
    model = config.make(
        family,
        seed=arguments.seed if arguments.seed >= 0 else None,
        device=arguments.device,
        num_threads=arguments.num_threads,
        cache_dir=arguments.cache_dir,
        verbose=0,
    )
    if arguments.delays is not None:
        from sb3_fedguide.common.participation import simulate_delays

        simulate_delays(model, read_delays(arguments.delays))
    if arguments.trained_agent is not None:
        model.import_parameters(arguments.trained_agent)
    return model


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
