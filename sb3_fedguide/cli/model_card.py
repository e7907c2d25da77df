"""The model card of a run on the Hugging Face hub: its returns, the commands to use it, and its learning curve."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fed_envs import FAMILIES, Family, load_family
from sb3_fedguide.cli.hub import CURVE
from sb3_fedguide.cli.run_folder import DEPLOYED, PARAMETERS
from sb3_fedguide.common.digits import decimals

#: Not the library ``stable-baselines3``, which is a tag: for it the hub would offer SB3's commands, with pickled archives.
LIBRARY = "sb3-fedguide"
TAGS = ("reinforcement-learning", "deep-reinforcement-learning", "federated-learning", "stable-baselines3", LIBRARY)
#: Packages whose versions the card names; ``versions.json`` has all.
NAMED = ("sb3-fedguide", "stable-baselines3", "torch", "gymnasium", "mujoco")
POLICIES = {"deployed": "as they left local training", "broadcast": "as the server sent them last"}


def write_card(folder: Path, repository: str, run: Mapping[str, Any], family: Family, packages: Sequence[str] = ()) -> str:
    """The text of a run's ``README.md``.

    :param folder: with the files that go to the hub
    :param repository: ``OWNER/NAME``
    :param run: its ``summary.json``
    :param family: its clients
    :param packages: modules to import first
    :raises ValueError: if the summary is damaged
    """
    try:
        returns = {policy: np.array(run[policy]["client_returns"], dtype=float) for policy in POLICIES if policy in run}
        front = yaml.safe_dump(_front_matter(run, returns), sort_keys=False, allow_unicode=True)
        return f"---\n{front}---\n\n{_body(folder, repository, run, family, returns, packages)}"
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise ValueError(f"summary.json is not the summary of a run: {error!r}") from None


def draw_curve(folder: Path, path: Path) -> None:
    """The run's learning curve as a picture.

    :raises ValueError: if its evaluations are damaged
    """
    from fed_envs.files import atomic_file
    from sb3_fedguide.benchmark.figures import layout
    from sb3_fedguide.benchmark.figures.curves import draw_curves
    from sb3_fedguide.cli.plot_runs import read_run_folder

    run = read_run_folder(folder)
    with atomic_file(path, "wb") as file:
        draw_curves({run.family: {run.name: [run]}}).savefig(file, format="png", dpi=layout.DPI)


def _front_matter(run: Mapping[str, Any], returns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    content: dict[str, Any] = {"library_name": LIBRARY, "tags": [*TAGS, str(run["env"]), str(run["algo"])]}
    if not returns:
        return content
    metrics = []
    places = _places(returns)
    for policy, values in returns.items():
        metrics += [
            {"type": "mean_reward", "value": f"{values.mean():.{places}f} +/- {values.std():.{places}f}", "verified": False,
             "name": f"mean_reward of the {policy} policies, mean and standard deviation over clients"},
            {"type": "mean_reward", "value": f"{values.min():.{places}f}", "verified": False,
             "name": f"mean_reward of the {policy} policies, client with the lowest"},
        ]  # fmt: skip
    result = {
        "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
        "dataset": {"name": str(run["env"]), "type": str(run["env"])},
        "metrics": metrics,
    }
    return {**content, "model-index": [{"name": str(run["algo"]), "results": [result]}]}


def _body(
    folder: Path,
    repository: str,
    run: Mapping[str, Any],
    family: Family,
    returns: Mapping[str, np.ndarray],
    packages: Sequence[str],
) -> str:
    algo, env = str(run["algo"]), str(run["env"])
    there, modules = f"logs/{algo}/{env}_1", f" --gym-packages {' '.join(packages)}" if packages else ""
    known = env in FAMILIES and load_family(env).content_hash == family.content_hash
    clients = f"--env {env}" if known else f"--metadata {there}/metadata.json"
    lines = [
        f"# {algo} on {env}",
        "",
        f"A federation of {int(run['n_clients'])} clients that sb3-fedguide has trained (federated reinforcement learning for "
        f"Stable-Baselines3): {int(run['rounds_done'])} rounds, {int(run['timesteps']):,} environment steps of all clients, "
        f"seed {int(run['seed'])}.",
        "",
        *_returns(folder, run, returns),
        "## Use",
        "",
        "```",
        "pip install 'sb3-fedguide[hub,onnx]'",
        f"fedguide pull {repository}{modules}    # prints the run's folder: {there}, or the next free number",
        f"fedguide evaluate {there}{modules}",
        f"fedguide export {there} --format sb3 onnx",
        f"fedguide train -i {there} --algo {algo} {clients}{modules}",
        "```",
        "",
        "`fedguide export` makes ordinary policies, one per client, which do not need this package.",
        "`fedguide train` starts a new run from this one; its network must be that of `config.yml` "
        "(`-params policy_kwargs.net_arch:[...]`).",
        "",
        "## Files",
        "",
        f"`{PARAMETERS}` has the learned parameters, as plain arrays"
        + (f", and `{DEPLOYED}` the policies before the last exchange" if (folder / DEPLOYED).is_file() else "")
        + ". `config.yml` has all hyperparameters, `metadata.json` describes the clients. Nothing here is pickled.",
    ]
    if versions := _versions(folder):
        lines += ["", f"Trained with {versions}."]
    return "\n".join(lines) + "\n"


def _returns(folder: Path, run: Mapping[str, Any], returns: Mapping[str, np.ndarray]) -> list[str]:
    """A table with a row for each client, and the learning curve."""
    if not returns:
        return ["This run was not evaluated.", ""]
    episodes = int(next(run[policy]["n_episodes"] for policy in returns))
    lines = [
        f"Return of an episode, mean over {episodes} seeded episodes of each client in its own environment. Policies: "
        + "; ".join(f"*{policy}*, {POLICIES[policy]}" for policy in returns)
        + ".",
        "",
        f"| client | {' | '.join(returns)} |",
        f"|---|{'---|' * len(returns)}",
    ]
    clients = [str(int(client)) for client in run["clients"]]
    places = _places(returns)
    columns = [[*values, values.mean(), values.min()] for values in returns.values()]
    for name, *row in zip([*clients, "average", "worst client"], *columns, strict=True):
        lines.append(f"| {name} | {' | '.join(f'{value:.{places}f}' for value in row)} |")
    return [*lines, "", *([f"![Return over rounds]({CURVE})", ""] if (folder / CURVE).is_file() else [])]


def _places(returns: Mapping[str, np.ndarray]) -> int:
    return decimals(np.concatenate(list(returns.values())).tolist())


def _versions(folder: Path) -> str:
    try:
        found = json.loads((folder / "versions.json").read_text(encoding="utf-8"))
        return ", ".join(f"{name} {found[name]}" for name in NAMED if name in found)
    except (OSError, ValueError, TypeError, RecursionError):
        return ""
