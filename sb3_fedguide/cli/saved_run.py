"""A trained run, from its folder: nothing in it is unpickled."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.registry import ALGORITHMS

if TYPE_CHECKING:
    import numpy as np

    from fed_envs import Family
    from sb3_fedguide.common.federation import Federation
    from sb3_fedguide.settings.config import Config


def read_run(folder: Path) -> tuple[dict[str, Any], Config, Family]:
    """``summary.json``, the hyperparameters and the family of a run folder.

    :raises ValueError: if the folder is not that of a trained run
    """
    from sb3_fedguide.cli.resume import read_settings
    from sb3_fedguide.cli.run_folder import PARAMETERS

    for name in ("summary.json", "metadata.json", "config.yml", PARAMETERS):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} is not the folder of a trained run: it has no {name}{_remedy(folder, name)}")
    try:
        run = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (ValueError, RecursionError, OSError) as error:
        raise ValueError(f"{folder / 'summary.json'} is not valid JSON: {error}") from None
    if not isinstance(run, dict) or not {"algo", "env", "rounds_done"} <= run.keys():
        raise ValueError(f"{folder / 'summary.json'} is not the summary of a run: it does not say algo, env and rounds_done")
    if not isinstance(run["algo"], str) or run["algo"] not in ALGORITHMS:
        raise ValueError(f"{folder}: unknown algorithm {run['algo']!r}; known are {', '.join(ALGORITHMS)}")
    return run, *read_settings(folder, run["algo"])


def _remedy(folder: Path, missing: str) -> str:
    """The remedy for a missing folder, a deployed client's folder, and runs of earlier versions, with only SB3's archive."""
    from sb3_fedguide.cli.pretrained import no_such_run
    from sb3_fedguide.deployment.site import PARAMETERS, SITE

    if not folder.exists():
        return no_such_run(folder)
    if missing == "summary.json" and any((place / PARAMETERS).is_file() for place in (folder, folder / SITE)):
        return "; it is a deployed client's folder: 'fedguide export' makes an ordinary policy from it, to evaluate"
    if missing != "parameters.npz" or not (folder / "model.zip").is_file():
        return ""
    return (
        "; if you trust it, load its model.zip in Python, which unpickles it, and call "
        f"export_parameters('{folder / missing}') on the model"
    )


def load_model(folder: Path, config: Config, family: Family) -> Federation:
    """The run's model from its settings and arrays; SB3's archive, which would be unpickled, is not read.

    :raises ValueError: if the two do not belong together, or a client's environment cannot be made
    """
    import torch as th

    from fed_envs import FederatedVecEnv
    from fed_envs.faults import ClientError
    from sb3_fedguide.cli.run_folder import PARAMETERS

    th.set_num_threads(1)
    try:
        env = FederatedVecEnv(family, config.values["n_envs_per_client"])
    except ClientError as error:  # from wrong keyword arguments in its metadata
        raise ValueError(f"{folder / 'metadata.json'}: {error}") from None
    model = config.make(env, seed=0, device="cpu")
    model.import_parameters(folder / PARAMETERS)
    return model


def read_deployed_policies(folder: Path, model: Federation) -> dict[str, np.ndarray]:
    """Parameters of the deployed policies; empty if they are the saved model's own.

    :raises ValueError: if the file is damaged or another model's
    """
    import numpy as np

    from sb3_fedguide.cli.run_folder import DEPLOYED, read_deployed
    from sb3_fedguide.state.array_files import array_mismatches

    deployed = read_deployed(folder)
    if deployed and (mismatches := array_mismatches(deployed, model.acting_arrays())):
        raise ValueError(f"{folder / DEPLOYED} does not fit the run's policies: {mismatches[0]}")
    if broken := [name for name, array in deployed.items() if not np.isfinite(array).all()]:
        raise ValueError(f"{folder / DEPLOYED}: {broken[0]} has non-finite entries")
    return deployed


@contextmanager
def in_place(model: Federation, arrays: dict[str, np.ndarray]) -> Iterator[None]:
    """Replace the model's parameters inside a ``with`` block."""
    before = model.acting_arrays()
    model.set_acting_arrays(arrays)
    try:
        yield
    finally:
        model.set_acting_arrays(before)
