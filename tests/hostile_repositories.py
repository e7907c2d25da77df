"""Hostile repositories of the hub for :mod:`tests.test_hub`, and how ``fedguide pull`` refuses them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import yaml

from sb3_fedguide.state.array_files import read_arrays, write_arrays
from tests.crafted_files import crafted_npz


def changed_arrays(run: Path, folder: Path, name: str, **arrays: np.ndarray | None) -> bytes:
    content = {**read_arrays(run / name), **arrays}
    write_arrays(folder / "changed.npz", {key: array for key, array in content.items() if array is not None})
    return (folder / "changed.npz").read_bytes()


def of_gymnasium(metadata: dict, clients: list[dict]) -> bytes:
    """Metadata of registered environments."""
    world = {"world": "gymnasium", "backbone": "Gymnasium", "max_episode_steps": 10}
    return json.dumps({**metadata, **world, "clients": clients}).encode()


def hostile(kind: str, files: dict[str, bytes], run: Path, folder: Path) -> None:
    """Change a repository's files into something that must not get through."""
    config, metadata = yaml.safe_load(files["config.yml"]), json.loads(files["metadata.json"])
    executed = folder / "executed"
    if kind.startswith("pickle"):
        name = kind.partition(" ")[2]
        crafted_npz(folder / "crafted.npz", executed, **read_arrays(run / name))
        files[name] = (folder / "crafted.npz").read_bytes()
    elif kind.startswith("bomb"):
        name = kind.partition(" ")[2]
        np.savez_compressed(folder / "bomb.npz", a=np.zeros(100_000))
        files[name] = (folder / "bomb.npz").read_bytes()
    elif kind == "tag":
        files["config.yml"] += f"seed: !!python/object/apply:os.mkdir ['{executed}']\n".encode()
    elif kind == "shape":
        files["parameters.npz"] = changed_arrays(run, folder, "parameters.npz", **{"policy/log_std": np.zeros((4, 3), "f4")})
    elif kind == "deployed shape":
        files["deployed.npz"] = changed_arrays(run, folder, "deployed.npz", log_std=np.zeros((4, 3), "f4"))
    elif kind == "nan":
        files["deployed.npz"] = changed_arrays(run, folder, "deployed.npz", log_std=np.full((4, 2), np.nan, "f4"))
    elif kind == "network":
        files["config.yml"] = yaml.safe_dump({**config, "policy_kwargs": {"net_arch": [8192] * 16}}).encode()
    elif kind == "environments":
        files["config.yml"] = yaml.safe_dump({**config, "n_envs_per_client": 1000, "rollout_size": 1000}).encode()
        metadata["clients"] = [{**metadata["clients"][0], "client": k} for k in range(5)]
        files["metadata.json"] = json.dumps(metadata).encode()
    elif kind == "family":
        files["metadata.json"] = json.dumps({**metadata, "family": "../../../etc"}).encode()
    elif kind == "algorithm":
        files["summary.json"] = json.dumps({**json.loads(files["summary.json"]), "algo": "../../x"}).encode()
    elif kind == "depth":
        files["summary.json"] = b"[" * 100_000
    elif kind == "keyword arguments":
        clients = [{"client": k, "id": "Ant-v5", "kwargs": {"xml_file": "/etc/passwd"}} for k in range(4)]
        files["metadata.json"] = of_gymnasium(metadata, clients)
    elif kind == "unknown argument":
        clients = [{"client": k, "id": "Pendulum-v1", "kwargs": {"foo": 1}} for k in range(4)]
        files["metadata.json"] = of_gymnasium(metadata, clients)
    elif kind == "module":
        clients = [{"client": k, "id": "this:Ant-v5"} for k in range(4)]
        files["metadata.json"] = of_gymnasium(metadata, clients)
    else:
        assert kind == "missing"
        del files["parameters.npz"]


HOSTILE = {
    "pickle parameters.npz": "me/run/parameters.npz is damaged: Object arrays cannot be loaded when allow_pickle=False",
    "pickle deployed.npz": "me/run/deployed.npz is damaged: Object arrays cannot be loaded",
    "bomb parameters.npz": "'a.npy' in it is compressed",
    "bomb deployed.npz": "'a.npy' in it is compressed",
    "tag": "config.yml is not valid YAML",
    "shape": "policy/log_std is float32 (4, 3) instead of float32 (4, 2)",
    "deployed shape": "log_std is float32 (4, 3) instead of float32 (4, 2)",
    "nan": "log_std has non-finite entries",
    "network": "asks for networks of",
    "environments": "asks for 5000 environments",
    "family": "family: String should match pattern",
    "algorithm": "unknown algorithm '../../x'",
    "depth": "summary.json is not valid JSON",
    "keyword arguments": "keyword argument '/etc/passwd', which may name a file or a module",
    "unknown argument": "me/run/metadata.json: client 0: the function that makes its environment raised TypeError",
    "module": "no environment 'this:Ant-v5' is registered",
    "missing": "me/run is not a run from 'fedguide push': it has no parameters.npz",
}
