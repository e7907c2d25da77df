"""Run a comparison of methods over seeds, one small result file per run, and print its table.

    python benchmarks/compare.py run --env HopperHard --seeds 0 1 2 --processes 2
    python benchmarks/compare.py table --env HopperHard

Runs that have their result file are not repeated, so an interrupted comparison goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from sb3_fedguide.algorithms import ALGORITHMS

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
METHODS = tuple(ALGORITHMS)
_COLUMNS = ("fedavg", "fedkl", "fedrl", "fedsvrpgm", "fedguide-a", "fedguide-p", "fedguide")
#: F of the paper, mean over its five seeds (its table of results, 10 or 4 epochs, 256-256 networks). The preferences of
#: ReacherHard and the tasks' rewards of MetaWorld10 (v3) are not the paper's, so these levels are not comparable.
PAPER = {
    family: dict(zip(_COLUMNS, values, strict=True))
    for family, values in {
        "Reacher": (-19.4, -20.9, -13.4, -24.9, -16.1, -12.2, -12.3),
        "ReacherHard": (-2531, -4274, -90.2, -8339, -1995, 90.7, 86.5),
        "HopperHard": (216, 242, 699, 387, 398, 437, 510),
        "MetaWorld10": (631, 445, 767, 668, 829, 914, 939),
    }.items()
}


def result_path(args: argparse.Namespace, method: str, seed: int) -> Path:
    return RESULTS / f"{args.env}-{args.label or args.conf or 'tuned'}" / f"{method}-seed{seed}.json"


def run_one(args: argparse.Namespace, method: str, seed: int) -> None:
    """One training run; its summary becomes the result file, atomically."""
    path = result_path(args, method, seed)
    if path.exists():
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(ROOT / "train.py"), "--algo", method, "--env", args.env, "--seed", str(seed)]
        command += ["-f", folder, "--verbose", "0", *(["-conf", args.conf] if args.conf else []), *args.arguments]
        log = Path(folder) / "output.txt"
        with log.open("w") as file:
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            code = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, env=environment).returncode
        summaries = list(Path(folder).rglob("summary.json"))
        if code or len(summaries) != 1:
            print(f"{method} seed {seed} failed:\n{log.read_text()[-2000:]}", file=sys.stderr, flush=True)
            return
        shutil.copyfile(summaries[0], path.with_suffix(".part"))
        path.with_suffix(".part").replace(path)
    print(f"{method} seed {seed}: {json.loads(path.read_text())['deployed']['average']:.1f}", flush=True)


def run(args: argparse.Namespace) -> None:
    jobs = [(method, seed) for seed in args.seeds for method in args.methods]
    with ThreadPoolExecutor(args.processes) as pool:
        list(pool.map(lambda job: run_one(args, *job), jobs))


def table(args: argparse.Namespace) -> None:
    """F (mean, deviation), W and CV over seeds, as the paper defines them."""
    print("| method | seeds | F | worst client | W | CV of the last 20 rounds | round 25 | round 50 | broadcast | paper F |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for method in args.methods:
        files = sorted(result_path(args, method, 0).parent.glob(f"{method}-seed*.json"))
        runs = [json.loads(file.read_text()) for file in files]
        if not runs:
            continue
        final = np.array([result["deployed"]["average"] for result in runs])
        worst = np.mean([result["deployed"]["worst_client"] for result in runs])
        curves = [dict(result["deployed"]["curve"]) for result in runs]
        last = [[value for round, value in curve.items() if round > max(curve) - 20] for curve in curves]
        volatility = np.mean([np.std(values) / abs(np.mean(values)) for values in last])
        early = [f"{np.mean([curve[round] for curve in curves]):.3g}" if round in curves[0] else "-" for round in (25, 50)]
        broadcast = [result["broadcast"]["average"] for result in runs if result.get("broadcast")]
        shared = f"{np.mean(broadcast):.4g}" if broadcast else "-"
        paper = PAPER.get(args.env, {}).get(method, "-")
        print(
            f"| {method} | {len(runs)} | {final.mean():.4g} ± {final.std():.3g} | {worst:.4g} | {final.min():.4g} "
            f"| {volatility:.3f} | {early[0]} | {early[1]} | {shared} | {paper} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("run", "table"))
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--conf", help="configuration, for example paper; the tuned one by default")
    parser.add_argument("--label", help="name of the results, by default the configuration's")
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--processes", type=int, default=2)
    args, args.arguments = parser.parse_known_args()
    {"run": run, "table": table}[args.command](args)


if __name__ == "__main__":
    main()
