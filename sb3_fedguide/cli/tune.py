"""The tuning command: trials with equal environment steps, in a resumable study."""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
import time
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import parse_train
from sb3_fedguide.cli.benchmark_arguments import train_flags
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.request import find_family, resolve_request
from sb3_fedguide.cli.run import one_message
from sb3_fedguide.cli.train import EXIT_INTERRUPTED, prepare
from sb3_fedguide.cli.tune_arguments import N_TRIALS, PASSED_ON, SETTINGS, parse_tune
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    import optuna

    from fed_envs import Family
    from sb3_fedguide.cli.signals import StopSignals
    from sb3_fedguide.cli.tune_space import Space
    from sb3_fedguide.cli.tune_trials import ActiveTrial
    from sb3_fedguide.settings.config import Config

#: Number of failed trials before the first success after which no more are begun.
MAX_FAILURES = 3
#: Shares of a trial's rounds: the median pruner's warm-up, and the halving pruner's first rung.
MEDIAN_WARM_UP, FIRST_RUNG = 3, 8
POLL = 0.1


@dataclass(frozen=True)
class Tuning:
    """The work of a tuning.

    :param flags: of the training command, for every run
    :param config: hyperparameters without those of a trial
    :param n_trials: number of trials of the study
    :param folder: of the study: a folder for every trial, and the best settings
    """

    arguments: argparse.Namespace
    prog: str
    flags: Sequence[str]
    family: Family
    config: Config
    space: Space
    n_trials: int
    name: str
    folder: Path
    storage: Path

    def train_flags(self, settings: Mapping[str, Any]) -> list[str]:
        """Flags of the training command with the settings of a trial."""
        return [*self.flags, "-params", *(f"{name}:{json.dumps(value)}" for name, value in settings.items())]

    def resolve(self, settings: Mapping[str, Any]) -> Config:
        """The complete hyperparameters of a trial.

        :raises ValueError: for settings that the algorithm refuses
        """
        arguments = parse_train([*self.train_flags(settings), "-f", str(self.folder)], self.prog)
        return prepare(resolve_request(arguments, self.family), "").config

    @property
    def identity(self) -> dict[str, Any]:
        """Settings that must be the same to resume a study."""
        arguments = self.arguments
        return {
            "algo": arguments.algo, "clients": self.family.content_hash, "space": json.dumps(self.space.plain()),
            "--seeds": arguments.seeds, "--eval-freq": arguments.eval_freq, "--eval-episodes": arguments.eval_episodes,
            **self.config.values,
        }  # fmt: skip


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "fedguide tune") -> int:
    """Run the command.

    :return: the exit code: 0, 1 if a trial failed or a file could not be written, 2 for wrong input, 130 after an interrupt
        (SIGINT), 143 after SIGTERM
    """
    arguments = parse_tune(argv, prog)
    try:
        if importlib.util.find_spec("optuna") is None:
            raise ValueError("tuning needs Optuna: pip install 'sb3-fedguide[tune]'")
        tuning = plan(arguments, prog)
        study = open_study(tuning)
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        print(f"{prog}: interrupted before the trials began", file=sys.stderr)
        return EXIT_INTERRUPTED
    from sb3_fedguide.cli.tune_table import conclude

    try:
        code = _run(tuning, study)
        conclude(tuning, study)
    except (ValueError, OSError) as error:
        print(f"{prog}: error: {one_message(error)}", file=sys.stderr)
        return EXIT_FAILED
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


def plan(arguments: argparse.Namespace, prog: str) -> Tuning:
    """Check everything, also every value of the search space; nothing is created.

    :raises ValueError: for anything that a user can correct
    """
    from sb3_fedguide.cli.run_folder import check_log_folder
    from sb3_fedguide.cli.tune_space import default_space, read_space

    import_packages(arguments.gym_packages)
    check_names([arguments.algo], ALGORITHMS, "algorithm")
    flags = train_flags(arguments, SETTINGS + PASSED_ON)
    parsed = parse_train([*flags, "-f", arguments.folder], prog)
    family = find_family(parsed)
    request = resolve_request(parsed, family)
    fixed = request.overrides
    space = read_space(Path(arguments.search), fixed) if arguments.search else default_space(arguments.algo, fixed)
    n_trials = arguments.n_trials or N_TRIALS
    if arguments.sampler == "grid":
        combinations = sum(1 for _ in space.grid())
        n_trials = min(combinations, arguments.n_trials or combinations)
    name = arguments.study_name or f"{family.name}-{arguments.algo}"
    folder = Path(arguments.folder).absolute() / name
    storage = Path(arguments.storage).absolute() if arguments.storage else folder / "study.db"
    check_log_folder(storage.parent)
    config = prepare(request, "").config
    tuning = Tuning(arguments, prog, flags, family, config, space, n_trials, name, folder, storage)
    for settings in space.probes():
        try:
            tuning.resolve(settings)
        except ValueError as error:
            raise ValueError(f"the search space has settings that {arguments.algo} refuses: {error}") from None
    return tuning


def open_study(tuning: Tuning) -> optuna.Study:
    """The study in its SQLite file, made if there is none.

    :raises ValueError: for a file that is not Optuna's, or a study with other settings
    """
    import optuna
    from sqlalchemy.exc import SQLAlchemyError

    from sb3_fedguide.cli.benchmark import differences

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    tuning.folder.mkdir(parents=True, exist_ok=True)
    tuning.storage.parent.mkdir(parents=True, exist_ok=True)
    try:
        # Several processes write to it: each waits for its turn.
        storage = optuna.storages.RDBStorage(f"sqlite:///{tuning.storage}", engine_kwargs={"connect_args": {"timeout": 60}})
        study = optuna.create_study(
            storage=storage,
            study_name=tuning.name,
            direction="maximize",
            pruner=_pruner(tuning),
            load_if_exists=True,
        )
        before = study.user_attrs.get("settings")
        if before is None:
            study.set_user_attr("settings", json.dumps(tuning.identity))
    except (SQLAlchemyError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"{tuning.storage} cannot be used as a study's storage ({reason}); give another --storage") from None
    if before is not None and (changed := differences(json.loads(before), tuning.identity)):
        raise ValueError(
            f"the study {tuning.name} in {tuning.storage} has other settings: {'; '.join(changed[:3])}; give another "
            "--study-name"
        )
    return study


def _pruner(tuning: Tuning) -> optuna.pruners.BasePruner:
    from optuna.pruners import MedianPruner, NopPruner, SuccessiveHalvingPruner

    rounds = tuning.config.n_rounds
    if tuning.arguments.pruner == "median":
        return MedianPruner(n_startup_trials=5, n_warmup_steps=rounds // MEDIAN_WARM_UP)
    if tuning.arguments.pruner == "halving":
        return SuccessiveHalvingPruner(min_resource=max(1, rounds // FIRST_RUNG), reduction_factor=2)
    return NopPruner()


def _run(tuning: Tuning, study: optuna.Study) -> int:
    """Do the missing trials and report each."""
    from sb3_fedguide.cli.signals import StopSignals

    n_done = len(_begun(study))
    _say(f"study {tuning.name}: {n_done} of {tuning.n_trials} trials done; {tuning.config.n_rounds} rounds and "
         f"{len(tuning.arguments.seeds)} seeds each, storage {tuning.storage}")  # fmt: skip
    active: list[ActiveTrial] = []
    outcomes: Counter[str] = Counter()
    with StopSignals() as signals:
        signals.can_wait = True
        try:
            while _fill(tuning, study, active, outcomes, signals) or active:
                for trial in [trial for trial in active if trial.is_over()]:
                    active.remove(trial)
                    trial.release()
                    outcomes[_tell(study, trial)] += 1
                time.sleep(POLL)
        except KeyboardInterrupt:
            pass  # the second signal: all runs have been killed, and signals.received has the first one
        finally:
            for trial in active:
                trial.release()
    if signals.received is not None:
        _say("interrupted; the same command resumes the study")
        return signals.exit_code
    if outcomes["failed"]:
        _say(f"{outcomes['failed']} trials failed")
    return EXIT_FAILED if outcomes["failed"] else 0


def _fill(
    tuning: Tuning, study: optuna.Study, active: list[ActiveTrial], outcomes: Counter[str], signals: StopSignals
) -> bool:
    """Begin missing trials while one may run; return whether there was one."""
    before = len(active)
    if signals.received is not None:
        for trial in active:
            trial.stop()
        return False
    if outcomes["failed"] >= MAX_FAILURES and not outcomes["complete"] + outcomes["pruned"]:
        return False  # all trials fail, and more of them would use up the study
    while len(active) < tuning.arguments.processes and signals.received is None:
        found = next_trial(tuning, study)
        if found is None:
            break
        active.append(found)
    return len(active) > before


def next_trial(tuning: Tuning, study: optuna.Study) -> ActiveTrial | None:
    """A begun trial that no process does now, or a new one; ``None`` if the study is complete."""
    import optuna
    from optuna.trial import TrialState

    from sb3_fedguide.cli.run_folder import exclusive

    with exclusive(tuning.folder, wait=True):
        for frozen in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            begun = optuna.Trial(study, frozen._trial_id)
            trial = _active(tuning, begun, tuning.space.suggest(begun), set(frozen.intermediate_values))
            try:
                trial.claim(_trial_folder(tuning, begun.number))
            except ValueError:
                continue  # another process does it
            return trial
        while len(_begun(study)) < tuning.n_trials:
            asked = _ask(tuning, study)
            settings = tuning.space.suggest(asked)
            if not _known(study, asked):
                trial = _active(tuning, asked, settings, set())
                trial.claim(_trial_folder(tuning, asked.number))
                return trial
    return None


def _ask(tuning: Tuning, study: optuna.Study) -> optuna.Trial:
    """A new trial. Its number is the sampler's seed, so that a resumed sampler does not propose the same again."""
    import optuna
    from optuna.trial import TrialState

    trials = study.get_trials(deepcopy=False)
    if tuning.arguments.sampler == "tpe":
        study.sampler = optuna.samplers.TPESampler(seed=len(trials), constant_liar=tuning.arguments.processes > 1)
    else:
        study.sampler = optuna.samplers.RandomSampler(seed=len(trials))
    if tuning.arguments.sampler == "grid" and not any(trial.state == TrialState.WAITING for trial in trials):
        tried = [trial.params for trial in trials]
        missing = next((setting for setting in tuning.space.grid() if setting not in tried), None)
        if missing is not None:
            study.enqueue_trial(missing)
    return study.ask()


def _known(study: optuna.Study, asked: optuna.Trial) -> bool:
    """Whether an earlier trial had the same settings; the trial then gets the same result without another run."""
    from optuna.trial import TrialState

    for earlier in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED)):
        if earlier.params == asked.params:
            for step, value in earlier.intermediate_values.items():
                asked.report(value, step)
            asked.set_user_attr("same_as", earlier.number)
            final = earlier.value if earlier.state == TrialState.COMPLETE else None
            study.tell(asked, final, state=earlier.state)
            _say(f"trial {asked.number}: the settings of trial {earlier.number}, and its result")
            return True
    return False


def _begun(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    from optuna.trial import TrialState

    return [trial for trial in study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING]


def _trial_folder(tuning: Tuning, number: int) -> Path:
    return tuning.folder / f"trial-{number}"


def _active(tuning: Tuning, trial: optuna.Trial, settings: Mapping[str, Any], reported: set[int]) -> ActiveTrial:
    from sb3_fedguide.cli.benchmark_runs import BenchmarkRun
    from sb3_fedguide.cli.tune_trials import ActiveTrial

    folder, algo = _trial_folder(tuning, trial.number), tuning.arguments.algo
    quiet = ("--verbose", "0", "--picture-freq", "0")
    runs = []
    for seed in tuning.arguments.seeds:
        log_folder = folder / "runs" / f"seed{seed}"
        runs.append(BenchmarkRun(
            method=algo,
            family=tuning.family.name,
            seed=seed,
            result=folder / f"{algo}-seed{seed}.json",
            log_folder=log_folder,
            flags=(*tuning.train_flags(settings), "--seed", str(seed), "-f", str(log_folder), *quiet),
            resume_flags=(*train_flags(tuning.arguments, PASSED_ON), *quiet),
            folder=Path.cwd(),
        ))  # fmt: skip
    return ActiveTrial(trial, settings, runs, tuning.config.n_rounds, tuning.family.n_clients, reported)


def _tell(study: optuna.Study, trial: ActiveTrial) -> str:
    """Report a trial to Optuna and the user; an interrupted trial stays unfinished."""
    from optuna.trial import TrialState

    shown = ", ".join(f"{name} {value}" for name, value in trial.settings.items())
    number = trial.trial.number
    if trial.value is not None:
        study.tell(trial.trial, trial.value)
        _say(f"trial {number}: {trial.value:.4g} ({shown})")
        return "complete"
    if trial.pruned:
        study.tell(trial.trial, state=TrialState.PRUNED)
        _say(f"trial {number}: pruned after {trial.rounds_done} rounds ({shown})")
        return "pruned"
    if trial.problem:
        study.tell(trial.trial, state=TrialState.FAIL)
        _say(f"trial {number} ({shown}) failed: {trial.problem}")
        return "failed"
    return "interrupted"


def _say(message: str) -> None:
    print(message, file=sys.stderr, flush=True)
