"""One run: its folder, its log, its training, and its results."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.signals import StopSignals
from sb3_fedguide.exit_codes import EXIT_USAGE

if TYPE_CHECKING:
    from stable_baselines3.common.logger import TensorBoardOutputFormat

    from sb3_fedguide.cli.request import Request
    from sb3_fedguide.cli.tracking import TrackerOutputFormat
    from sb3_fedguide.common.callbacks import RoundCallback
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

LONGEST_MESSAGE = 2000


class Run:
    """A run with checked inputs; calling it trains."""

    def __init__(
        self,
        request: Request,
        command: str,
        model: FederatedPPO | FederatedDDPG,
        folder: Path | None = None,
        longer: bool = False,
    ) -> None:
        """:param folder: of the run, if it is resumed
        :param longer: whether it then gets a new number of rounds
        """
        self.folder, self.longer = folder, longer
        #: lock against other processes in that folder
        self.lock = ExitStack()
        self.arguments, self.config, self.family = request.arguments, request.config, request.family
        self.command, self.model = command, model

    def __call__(self) -> int:
        from sb3_fedguide.cli.run_folder import create_run_folder, exclusive

        arguments = self.arguments
        if self.folder is not None:
            with self.lock:
                if self.longer:
                    self._record_length(self.folder)
                with (self.folder / "command.txt").open("a", encoding="utf-8") as file:
                    file.write(self.command + "\n")
                return self._run(self.folder)
        folder = create_run_folder(Path(arguments.log_folder), arguments.algo, self.family.name)
        with exclusive(folder):
            self._record_inputs(folder)
            return self._run(folder)

    def _run(self, folder: Path) -> int:
        from sb3_fedguide.cli.report import print_summary
        from sb3_fedguide.cli.run_folder import DEPLOYED, PARAMETERS, write_deployed, write_json
        from sb3_fedguide.common.checkpoint import CheckpointError

        arguments, model = self.arguments, self.model
        self._set_logger(folder)
        if arguments.verbose:
            begun = f", resuming after round {model.round}" if self.folder is not None else ""
            print(f"{arguments.algo} on {self.family.name}: {model.n_clients} clients, {self.config.n_rounds} rounds, "
                  f"writing to {folder}{begun}", flush=True)  # fmt: skip
        exit_code, signals = 0, StopSignals()
        try:
            with signals:
                self._train(folder, signals)
        except KeyboardInterrupt:
            where = f"round {model.round + 1}" if model.pretrained else "the offline stage"
            print(f"\ninterrupted in {where}; {self._what_stays(folder)}", file=sys.stderr)
            exit_code = signals.exit_code
        except (OfflineStageError, CheckpointError) as error:
            stage = "" if isinstance(error, CheckpointError) else " in the offline stage"
            print(f"error{stage}: {one_message(error)}", file=sys.stderr)
            return EXIT_USAGE
        else:
            if signals.received is not None and model.round < self.config.n_rounds:
                print(f"interrupted in round {model.round}, which is complete; {self._what_stays(folder)}", file=sys.stderr)
                exit_code = signals.exit_code
        finally:
            model.logger.close()
        if model.round > 0:
            model.save(folder / "model.zip")
            model.export_parameters(folder / PARAMETERS)
            if deployed := self._deployed.replaced():
                write_deployed(folder, deployed)
            else:
                (folder / DEPLOYED).unlink(missing_ok=True)  # of an earlier part of this run
        summary = self._summary()
        write_json(folder / "summary.json", summary)
        if self._tracker is not None:
            self._tracker.finish(summary)
        if arguments.verbose:
            print_summary(summary, str(folder))
        return exit_code

    def _what_stays(self, folder: Path) -> str:
        return f"the results so far stay in {folder}, and --resume {folder} resumes the run"

    def _record_inputs(self, folder: Path) -> None:
        from sb3_fedguide.cli.run_folder import versions, write_json, write_text, write_yaml

        write_yaml(folder / "config.yml", self.config.values)
        events = self.arguments.tensorboard_log
        tensorboard_log = (
            None if events is None else str(Path(events).absolute())
        )  # a run may be resumed from another working directory
        arguments = {**vars(self.arguments), "seed": self.model.seed, "tensorboard_log": tensorboard_log}
        write_yaml(folder / "args.yml", arguments)
        write_text(folder / "command.txt", self.command + "\n")
        write_json(folder / "versions.json", versions())
        self.family.dump(folder / "metadata.json")
        write_text(folder / "metadata.sha256", self.family.content_hash + "\n")

    def _record_length(self, folder: Path) -> None:
        """Write the new length of a resumed run, for further resumes too."""
        from sb3_fedguide.cli.run_folder import write_yaml
        from sb3_fedguide.settings.config import read_yaml

        write_yaml(folder / "config.yml", self.config.values)
        write_yaml(folder / "args.yml", {**read_yaml(folder / "args.yml"), "rounds": self.arguments.rounds,
                                         "n_timesteps": self.arguments.n_timesteps})  # fmt: skip

    def _set_logger(self, folder: Path) -> None:
        from stable_baselines3.common.logger import KVWriter, Logger, TensorBoardOutputFormat

        from sb3_fedguide.cli.round_table import RoundTable
        from sb3_fedguide.cli.run_folder import events_folder

        arguments = self.arguments
        events = events_folder(folder, arguments.tensorboard_log, self.family.name, arguments.algo)
        loud = arguments.verbose == 2 or (arguments.verbose == 1 and not arguments.progress)
        events_output = TensorBoardOutputFormat(str(events))
        if self.folder is not None:
            forget_later_events(events_output, self.model.environment_steps)
        outputs: list[KVWriter] = [events_output]
        self._tracker = self._make_tracker(folder)
        if self._tracker is not None:
            outputs.append(self._tracker)
        if loud:
            outputs.append(RoundTable(sys.stdout))
        self.model.set_logger(Logger(str(events), outputs))

    def _make_tracker(self, folder: Path) -> TrackerOutputFormat | None:
        arguments = self.arguments
        if arguments.track is None:
            return None
        from sb3_fedguide.cli.arguments import TRACK_PROJECT
        from sb3_fedguide.cli.tracking import TrackerOutputFormat

        shown = {"algo": arguments.algo, "family": self.family.name, "seed": self.model.seed, **self.config.values}
        return TrackerOutputFormat(
            arguments.track, arguments.track_project or TRACK_PROJECT, folder, shown, self.folder is not None
        )

    def _train(self, folder: Path, signals: StopSignals) -> None:
        from sb3_fedguide.cli.recorder import CostCallback, DeployedCallback, RunEvalCallback, StopCallback
        from sb3_fedguide.cli.run_folder import CHECKPOINTS, EVALUATIONS
        from sb3_fedguide.cli.status import Status
        from sb3_fedguide.common.checkpoint import CheckpointCallback
        from sb3_fedguide.engines import make_engine
        from sb3_fedguide.engines.engine import EngineError
        from sb3_fedguide.offline.progress import TqdmProgress

        arguments, model = self.arguments, self.model
        self._costs, self._deployed, self._evaluation = CostCallback(), DeployedCallback(), None
        if not arguments.no_eval:
            self._evaluation = RunEvalCallback(
                self.config.n_rounds, arguments.eval_freq, arguments.eval_episodes, folder / EVALUATIONS
            )
        status = Status(folder, self.config.n_rounds, TqdmProgress() if arguments.progress else None)
        try:
            model.pretrain(progress=status)
        except ValueError as error:
            raise OfflineStageError(str(error)) from error
        self._costs.pretraining_seconds = self._costs.total_seconds
        checkpoint = CheckpointCallback(folder / CHECKPOINTS, arguments.save_freq) if arguments.save_freq else None
        recorders = [self._evaluation, self._costs, self._deployed, status]
        callbacks = [*recorders, *self._monitoring(folder), checkpoint, StopCallback(signals, checkpoint)]
        engine = make_engine(arguments.engine, arguments.num_actors, arguments.ray_address)
        with ExitStack() as stack:
            if engine is not None:
                try:
                    stack.enter_context(engine).attach(model)
                except (ValueError, OSError) as error:  # no cluster at that address, or too small a one
                    raise EngineError(f"--engine {arguments.engine}: {one_message(error)}") from error
            self._learn(callbacks)
        if checkpoint is not None and model.round >= self.config.n_rounds:
            checkpoint.save()  # for --resume with more rounds
        status.remove()

    def _learn(self, callbacks: list[RoundCallback | None]) -> None:
        model = self.model
        model.learn(
            self.config.n_rounds * model.rollout_size * model.n_participants - model.num_timesteps,
            [callback for callback in callbacks if callback is not None],
            reset_num_timesteps=model.round == 0,
            progress_bar=self.arguments.progress,
        )

    def _monitoring(self, folder: Path) -> list[RoundCallback]:
        from sb3_fedguide.cli.run_folder import PLAN
        from sb3_fedguide.monitoring.callbacks import TensorBoardCallback
        from sb3_fedguide.monitoring.diagnostics import DiagnosticsCallback
        from sb3_fedguide.monitoring.health import HealthCallback
        from sb3_fedguide.monitoring.plan import PlanCallback
        from sb3_fedguide.settings.schema import all_names

        shown = {"algo": self.arguments.algo, "family": self.family.name, "seed": self.model.seed, **self.config.values}
        pictures = TensorBoardCallback(self.config.n_rounds, self.arguments.picture_freq, shown, all_names())
        diagnostics = DiagnosticsCallback(self._evaluation if self.arguments.eval_average else None)
        return [diagnostics, HealthCallback(), PlanCallback(folder / PLAN), pictures]

    def _summary(self) -> dict[str, Any]:
        from sb3_fedguide.cli.report import summarize

        return summarize(
            self.model,
            self._costs,
            self._evaluation,
            self._costs.pretraining_seconds,
            self._costs.total_seconds,
            algo=self.arguments.algo,
            env=self.family.name,
            conf_file=self.arguments.conf_file,
            metadata_hash=self.family.content_hash,
            n_rounds=self.config.n_rounds,
        )


def forget_later_events(output: TensorBoardOutputFormat, timesteps: int) -> None:
    """Tell TensorBoard that a run is resumed from ``timesteps``: it hides events of later steps in earlier files."""
    from tensorboard.compat.proto.event_pb2 import Event, SessionLog

    start = Event(step=timesteps + 1, session_log=SessionLog(status=SessionLog.START))
    output.writer._get_file_writer().add_event(start)


class OfflineStageError(Exception):
    """An error in the offline stage that the user can correct, such as a dataset that cannot be read."""


def one_message(error: Exception) -> str:
    """An error's message with its lines indented below the first; only beginning and end of a very long one."""
    message = str(error)
    if len(message) > LONGEST_MESSAGE:
        half = LONGEST_MESSAGE // 2
        message = f"{message[:half]} ... {message[-half:]}"
    return "\n  ".join(message.splitlines())
