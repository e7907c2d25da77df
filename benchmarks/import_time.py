"""Seconds until the package is there: ``import sb3_fedguide``, its first class, and ``train.py --help``.

    python benchmarks/import_time.py

Each in a fresh interpreter, several times; CPU seconds are what remains of it on a busy machine. ``python -X importtime``
shows what they are made of. Writes ``benchmarks/results/import_time.json``.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time
from pathlib import Path

from record import spread, write_result

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = {
    "python -c pass": ["-c", "pass"],
    "import sb3_fedguide": ["-c", "import sb3_fedguide"],
    "import fed_envs": ["-c", "import fed_envs"],
    "train.py --help": ["train.py", "--help"],
    "from sb3_fedguide import FedGuide": ["-c", "from sb3_fedguide import FedGuide"],
}


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()

    figures = {}
    for name, command in COMMANDS.items():
        wall, cpu = [], []
        for _ in range(args.repeats):
            started, used = time.perf_counter(), cpu_seconds()
            subprocess.run([sys.executable, *command], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
            wall.append(time.perf_counter() - started)
            cpu.append(cpu_seconds() - used)
        figures[name] = {"seconds": spread(wall), "cpu_seconds": spread(cpu)}
        print(f"{name:34} {figures[name]['seconds']['median']:6.2f} s, {figures[name]['cpu_seconds']['median']:6.2f} s of CPU")
    print(f"written to {write_result('import_time', {'command': vars(args), 'figures': figures})}")


if __name__ == "__main__":
    main()
