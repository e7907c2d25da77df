"""Result files of runs that nobody did, for the tests of tables and figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import fed_envs

CLIENTS = [0, 1, 2, 3]


def summary(**changes) -> dict:
    """What a result file holds; ``curve`` goes into ``deployed``."""
    deployed = {"average": 1.0, "worst_client": 0.5, "n_episodes": 3, "success_rates": None, "curve": [[1, 2.0], [2, 4.0]]}
    optional = ("client_returns", "client_curve")
    deployed.update({name: changes.pop(name) for name in list(changes) if name in deployed or name in optional})
    content = {
        "algo": "local", "env": "Bandit2D", "conf_file": "tuned", "n_rounds": 3, "seed": 0, "rounds_done": 3, "finished": True,
        "metadata_hash": fed_envs.load_family("Bandit2D").content_hash, "bytes_up": 6000, "bytes_down": 3_000_000,
        "seconds": {"median_round": 0.5, "total": 7.0}, "deployed": deployed,
    }  # fmt: skip
    return {**content, **changes}


def write_result(folder: Path, label: str = "tuned", **changes) -> Path:
    content = summary(**changes)
    path = folder / f"{content['env']}-{label}" / f"{content['algo']}-seed{content['seed']}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def result(folder: Path, algo: str = "local", seed: int = 0, level: float = 1.0, label: str = "tuned", **changes) -> Path:
    """A finished run of three rounds; the client-average returns are 1, 2 and 3 times ``level``, clients lie around it."""
    around = np.array([0.7, 0.9, 1.1, 1.3])
    returns = [[round, 1000 * round, list(level * round * around)] for round in (1, 2, 3)]
    content = summary(
        algo=algo, seed=seed, average=3 * level, worst_client=2.1 * level, curve=[[r, level * r] for r in (1, 2, 3)],
        timesteps=3000, clients=CLIENTS, offline_bytes_up=0, offline_bytes_down=0,
        seconds={"median_round": 0.5, "total": 9.0, "rollout": 3.0, "train": 2.0, "exchange": 1.0},
    )  # fmt: skip
    content["deployed"] |= {"client_returns": returns[-1][2], "client_curve": returns}
    content |= changes
    path = folder / f"{content['env']}-{label}" / f"{algo}-seed{seed}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def two_families(folder: Path) -> Path:
    """Bandit2D and a family of two of its clients with two methods and seeds; the family's file."""
    content = fed_envs.load_family("Bandit2D").to_dict()
    content["family"], content["clients"] = "Mine", content["clients"][:2]
    path = folder / "mine.json"
    path.write_text(json.dumps(content))
    own = fed_envs.load_family(path).content_hash
    for name, family_hash in (("Bandit2D", fed_envs.load_family("Bandit2D").content_hash), ("Mine", own)):
        for seed in (0, 1):
            result(folder, "local", seed, 1.0 + 0.1 * seed, env=name, metadata_hash=family_hash)
            result(folder, "fedavg", seed, 0.8 + 0.3 * seed, env=name, metadata_hash=family_hash)
        kept = folder / "random-actions" / f"{name}.json"
        kept.parent.mkdir(exist_ok=True)
        kept.write_text(json.dumps({"metadata_hash": family_hash, "average": 0.3}))
    return path
