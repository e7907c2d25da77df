"""Make a finished run one of those that come with the package, in `sb3_fedguide/pretrained/<family>`.

    python train.py --algo fedguide --env Bandit2D --seed 0 -params 'policy_kwargs.net_arch:[32,32]' pretraining.dice_width:32
    python benchmarks/ship_run.py logs/fedguide/Bandit2D_1 --commit "$(git rev-parse --short HEAD)"

Copies what evaluations read, and writes `provenance.json` beside it: commands, commit, versions, seed, returns, and what
random actions return. Networks of the shipped runs are small, so that all of them together stay below 300 kB.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
from collections.abc import Sequence
from pathlib import Path

from fed_envs import load_family
from sb3_fedguide.benchmark.aggregate import random_actions
from sb3_fedguide.cli.pretrained import PRETRAINED
from sb3_fedguide.cli.run_folder import write_json
from sb3_fedguide.cli.saved_run import read_run

COPIED = ("config.yml", "metadata.json", "parameters.npz", "deployed.npz", "summary.json")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--commit", required=True, help="of the code that trained it")
    arguments = parser.parse_args()
    run, _, family = read_run(arguments.run)
    target = PRETRAINED / family.name
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for name in COPIED:
        if (arguments.run / name).is_file():
            shutil.copyfile(arguments.run / name, target / name)
    random = random_actions(load_family(family.name))
    found = {"deployed": run["deployed"]["client_returns"], "random actions": random.client_returns.tolist()}
    write_json(
        target / "provenance.json",
        {
            "commands": (arguments.run / "command.txt").read_text().splitlines(),
            "commit": arguments.commit,
            "seed": run["seed"],
            "rounds": run["rounds_done"],
            "environment_steps": run["timesteps"],
            "returns": {name: _numbers(values) for name, values in found.items()},
            "n_episodes": run["deployed"]["n_episodes"],
            "versions": json.loads((arguments.run / "versions.json").read_text()),
        },
    )
    print(f"{target}: {sum(path.stat().st_size for path in target.iterdir()) / 1000:.0f} kB")


def _numbers(values: Sequence[float]) -> dict[str, object]:
    return {"average": round(statistics.fmean(values), 4), "clients": [round(value, 4) for value in values]}


if __name__ == "__main__":
    main()
