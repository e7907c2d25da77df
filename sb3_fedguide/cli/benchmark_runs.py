"""The runs of a benchmark: each is a training command in its own process, which resumes an earlier one."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_fedguide.cli.resume import finished_rounds
from sb3_fedguide.cli.run_folder import exclusive
from sb3_fedguide.cli.signals import StopSignals
from sb3_fedguide.cli.status import read_status
from sb3_fedguide.settings.config import read_yaml

#: The training command; a run's flags follow.
TRAIN = (sys.executable, "-m", "sb3_fedguide", "train")
#: Inside the folder of a family's results: the folders of unfinished runs.
RUNS = "runs"
#: Seconds between checks of the runs.
POLL = 0.1
#: Seconds between reports of the runs' progress.
REPORT = 60.0
#: Lines of a failed run's output in its report.
SHOWN_LINES = 12


@dataclass(frozen=True)
class BenchmarkRun:
    """One run to do. Paths are absolute: it may be done on another machine.

    :param result: result file; the run is done if it exists
    :param log_folder: folder of its training command's output, used by no other run
    :param flags: of the training command, to begin
    :param resume_flags: of the training command, to resume
    :param folder: working directory of the commands, if the machine has it
    :param title: displayed name of the method; by default its name
    """

    method: str
    family: str
    seed: int
    result: Path
    log_folder: Path
    flags: tuple[str, ...]
    resume_flags: tuple[str, ...]
    folder: Path
    title: str = ""

    @property
    def name(self) -> str:
        return f"{self.title or self.method} on {self.family}, seed {self.seed}"


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    :param content: of its result file, if it is finished
    :param problem: the reason if it is not
    :param interrupted: whether it was stopped by a signal
    """

    content: Mapping[str, Any] | None = None
    problem: str = ""
    interrupted: bool = False


def log_folder_of(result: Path) -> Path:
    """The folder of the training command's output, for the run with this result file."""
    return result.parent / RUNS / result.stem


def interrupted_folder(log_folder: Path, method: str) -> Path | None:
    """The folder of a run that began in ``log_folder`` and can be resumed: the last one with all of its inputs."""
    folders = [path.parent for path in (log_folder / method).glob("*_*/metadata.json")]
    return max(folders, key=lambda folder: int(folder.name.rsplit("_", 1)[1]), default=None)


class RunProcess:
    """A run's training command in its own process, with the exclusive right to do the run until :meth:`release`."""

    def __init__(self, run: BenchmarkRun) -> None:
        self.run = run
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = ExitStack()
        self._log = run.log_folder / "output.txt"
        self._log_start, self._stopped = 0, False

    def start(self) -> None:
        """Start it, unless another benchmark has finished it in the meantime.

        :raises ValueError: if another process is doing this run
        """
        run = self.run
        run.log_folder.mkdir(parents=True, exist_ok=True)
        self._lock.enter_context(exclusive(run.log_folder))
        if run.result.is_file():
            return
        before = interrupted_folder(run.log_folder, run.method)
        flags = run.flags if before is None else ("--resume", str(before), *run.resume_flags)
        with self._log.open("ab") as log:
            self._log_start = log.tell()
            self._process = subprocess.Popen(
                [*TRAIN, *flags],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=run.folder if run.folder.is_dir() else None,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # the terminal's Ctrl-C is for the benchmark, which tells its runs to stop
            )

    def is_running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def doing(self) -> str:
        """Its stage, with the seconds so far and the remaining ones."""
        folder = interrupted_folder(self.run.log_folder, self.run.method)
        stage = None if folder is None else read_status(folder)
        return "beginning" if stage is None else str(stage)

    def stop(self) -> None:
        """Let it end after its current round, with a checkpoint."""
        if not self._stopped and self._process is not None:
            self._stopped = True
            self._process.terminate()

    def kill(self) -> None:
        """Kill it and its child processes."""
        self._stopped = True
        if self._process is not None and self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        self.release()

    def release(self) -> None:
        """Let others do the run."""
        self._lock.close()

    def outcome(self) -> Outcome:
        """Its outcome, after its end."""
        if self._process is None:
            return Outcome(json.loads(self.run.result.read_text(encoding="utf-8")))
        code = self._process.returncode
        if code == 0 and (content := _content(self.run)) is not None:
            return Outcome(content)
        if self._stopped:
            return Outcome(problem="interrupted", interrupted=True)
        if code < 0:
            return Outcome(problem=f"its process was killed ({signal.Signals(-code).name})")
        with self._log.open("rb") as log:
            log.seek(self._log_start)
            lines = log.read().decode(errors="replace").splitlines()
        shown = "\n  ".join(lines[-SHOWN_LINES:]) or "it wrote nothing"
        more = f"\n  (all of it: {self._log})" if len(lines) > SHOWN_LINES else ""
        return Outcome(problem=f"it ended with exit code {code}:\n  {shown}{more}")


def _content(run: BenchmarkRun) -> dict[str, Any] | None:
    """The content of a run's result file, if the run is finished."""
    folder = interrupted_folder(run.log_folder, run.method)
    if folder is None or finished_rounds(folder) is None:
        return None
    summary, versions = [json.loads((folder / f"{name}.json").read_text(encoding="utf-8")) for name in ("summary", "versions")]
    return {**summary, "config": read_yaml(folder / "config.yml"), "versions": versions}


def execute(run: BenchmarkRun) -> Outcome:
    """Do one run and wait for it. SIGINT, with which Ray cancels a task, lets it end after its current round."""
    process = RunProcess(run)
    earlier = signal.signal(signal.SIGINT, lambda *_: process.stop())
    try:
        process.start()
        while process.is_running():
            time.sleep(POLL)
        return process.outcome()
    except (ValueError, OSError) as error:
        return Outcome(problem=str(error))
    finally:
        process.kill()
        signal.signal(signal.SIGINT, earlier)


def run_here(
    runs: Sequence[BenchmarkRun],
    n_processes: int,
    signals: StopSignals,
    done: Callable[[BenchmarkRun, Outcome], None],
    say: Callable[[str], None],
) -> None:
    """Do the runs in processes on this machine.

    :param n_processes: runs at a time
    :param signals: after the first signal, no run begins and the others end after their round; at the second, all are killed
    :param done: called for each run that ends, and for runs that could not be started
    :param say: called every minute with each run's progress
    """
    waiting, running, reported = deque(runs), list[RunProcess](), time.monotonic()
    try:
        while running or (waiting and signals.received is None):
            if signals.received is not None:
                for process in running:
                    process.stop()
            while waiting and len(running) < n_processes and signals.received is None:
                running.append(RunProcess(waiting.popleft()))
                try:
                    running[-1].start()
                except (ValueError, OSError) as error:
                    done(running.pop().run, Outcome(problem=str(error)))
            for process in [process for process in running if not process.is_running()]:
                done(process.run, process.outcome())
                running.remove(process)
                process.release()
            if time.monotonic() - reported >= REPORT:
                reported = time.monotonic()
                for process in running:
                    say(f"  {process.run.name}: {process.doing()}")
            time.sleep(POLL)
    finally:
        for process in running:
            process.kill()


def forget(run: BenchmarkRun) -> None:
    """Remove all files of a finished run except its result."""
    shutil.rmtree(run.log_folder, ignore_errors=True)
    with suppress(OSError):  # other runs are still there
        run.log_folder.parent.rmdir()
