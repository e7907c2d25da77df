"""The training command: check everything, then write a run folder, train, evaluate and report.

Nothing is created on disk, and neither PyTorch nor the simulator is imported, before the flags are known to be sound.
"""

from __future__ import annotations

import shlex
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.request import Request, check_tracker, find_family, resolve_request
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
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

EXIT_INTERRUPTED = 130
PACKAGE = Path(__file__).parents[1]


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "train.py") -> int:
    """Run the command.

    :return: the exit code: 0, 1 if a file could not be written or a client failed, 2 for wrong input, 130 after an
        interrupt (SIGINT), 143 after SIGTERM, 129 after SIGHUP
    """
    arguments = parse_train(argv, prog)
    command = shlex.join(sys.orig_argv if argv is None else [prog, *argv])
    try:
        if arguments.resume is not None:
            run = resume(Path(arguments.resume), given_flags(argv, prog), command, prog)
        else:
            import_packages(arguments.gym_packages)
            run = prepare(resolve_request(arguments, find_family(arguments)), command)
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
        print(f"{prog}: error: {one_message(error)}; earlier files stay", file=sys.stderr)
        return EXIT_FAILED
    except EngineError as error:
        print(f"{prog}: error: {error}", file=sys.stderr)
        return EXIT_FAILED
    except BrokenPipeError:
        raise
    except OSError as error:  # a full disk, or a folder that is read-only
        where = error.filename or arguments.log_folder
        print(f"{prog}: error: {where}: {error.strerror or error}; earlier files stay", file=sys.stderr)
        return EXIT_FAILED


@contextmanager
def _no_reports_of_threads() -> Iterator[None]:
    """Suppress reports of TensorBoard's own writer thread. Its next call here raises the error again; once is enough."""
    before = threading.excepthook
    threading.excepthook = lambda failure: None if isinstance(failure.exc_value, OSError) else before(failure)
    try:
        yield
    finally:
        threading.excepthook = before


@contextmanager
def _short_warnings(prog: str) -> Iterator[None]:
    """Show warnings of this package without the line of code that Python adds."""
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
    """A function that resumes the run in ``folder``; the folder is locked until then.

    :param given: the flags on the command line
    :raises ValueError: if the run cannot be resumed
    """
    from sb3_fedguide.cli.delays import read_delays
    from sb3_fedguide.cli.run_folder import exclusive

    arguments = read_arguments(folder, given, prog)
    check_tracker(arguments.track)
    import_packages(arguments.gym_packages)
    before, family = read_settings(folder, arguments.algo)
    config = with_length(before, family, given)
    delays = None if arguments.delays is None else read_delays(arguments.delays)
    request = Request(arguments, family, config, delays)
    with ExitStack() as stack:
        stack.enter_context(exclusive(folder))
        if (rounds := finished_rounds(folder)) is not None:
            check_length(folder, config, rounds)
            if config.n_rounds == rounds:
                print(f"the run in {folder} is finished: it has done its {rounds} rounds")
                return lambda: 0
        run = Run(request, command, make_model(request), folder, longer=config != before)
        if load_checkpoint(folder, run.model.resume, prog):
            check_length(folder, config, run.model.round)
        run.lock = stack.pop_all()
    return run


def prepare(request: Request, command: str) -> Run:
    """Construct the algorithm; nothing is written yet.

    :raises ValueError: if the settings do not fit the environments or the data
    """
    dataset = request.config.values["pretraining"]["dataset"]
    if dataset is not None:
        _check_dataset(dataset, request.family)
    model = make_model(request)
    model.check_offline_data()
    return Run(request, command, model)


def make_model(request: Request) -> FederatedPPO | FederatedDDPG:
    """Construct the algorithm.

    :raises ValueError: if the settings do not fit together
    """
    import torch as th

    arguments = request.arguments
    _check_device(arguments.device)
    th.set_num_threads(1)
    model = request.config.make(
        request.family,
        seed=arguments.seed if arguments.seed >= 0 else None,
        device=arguments.device,
        num_threads=arguments.num_threads,
        cache_dir=arguments.cache_dir,
        verbose=0,
    )
    if request.delays is not None:
        from sb3_fedguide.common.participation import simulate_delays

        simulate_delays(model, request.delays)
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
