"""A client's own configuration in a real federation: which client it is, in which world, and with which settings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

import fed_envs
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.config import resolve
from sb3_fedguide.settings.evaluation import EVAL_EPISODES, EVAL_FREQ
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.pretraining import Count
from sb3_fedguide.settings.schema import check_model

if TYPE_CHECKING:
    from sb3_fedguide.common.federation import Federation


class SiteConfig(BaseModel):
    """A client's configuration; ``algo``, ``client``, ``seed`` and one of ``env`` and ``metadata`` are required.

    :param algo: command-line name of the algorithm
    :param env: name of the family
    :param metadata: its file instead
    :param client: this client's id in the family
    :param seed: of the federation, the same for all
    :param conf: as ``-conf``
    :param params: as ``-params``
    :param n_rounds: instead of the configuration's
    :param eval_freq: rounds between evaluations; 0 for none
    :param eval_episodes: episodes of each
    :param report: send losses and returns to the server
    :param packages: as ``--gym-packages``
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    algo: str | None = None
    env: str | None = None
    metadata: str | None = None
    client: Annotated[int, Field(ge=0)] | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] | None = None
    conf: str = "tuned"
    params: dict[str, Any] = {}
    n_rounds: Count | None = None
    eval_freq: Annotated[int, Field(ge=0)] = EVAL_FREQ
    eval_episodes: Count = EVAL_EPISODES
    report: bool = True
    cache_dir: str | None = None
    num_threads: Count = 1
    device: str = "cpu"
    packages: list[str] = []


def read_site_config(config: Mapping[str, Any]) -> SiteConfig:
    """Check a configuration, and import its packages.

    :raises ValueError: for anything unknown, missing, of the wrong type or out of range
    """
    from sb3_fedguide.settings.packages import import_packages

    checked = check_model("the client's configuration", SiteConfig, config, {})
    assert isinstance(checked, SiteConfig)
    import_packages(checked.packages)
    for name in ("algo", "client", "seed"):
        if getattr(checked, name) is None:
            raise ValueError(f"the client's configuration does not say {name}; every client states algo, client and seed")
    if (checked.env is None) == (checked.metadata is None):
        raise ValueError("the client's configuration has to say one of env, a family's name, and metadata, its file")
    if checked.metadata is not None and not Path(checked.metadata).is_file():
        raise ValueError(f"the client's configuration: there is no metadata file {checked.metadata}")
    if "n_rounds" in checked.params and checked.n_rounds is not None:
        raise ValueError("the client's configuration says n_rounds twice, once in params; leave one of them out")
    check_names([str(checked.algo)], ALGORITHMS, "algorithm")
    if checked.env is not None:
        check_names([checked.env], fed_envs.FAMILIES, "environment")
    return checked


def make_client(checked: SiteConfig) -> tuple[Federation, int]:
    """The client's federation of one, and the rounds of the run.

    :raises ValueError: if the settings do not fit together, or there is no such client
    """
    import torch as th

    th.set_num_threads(1)  # as in training by the command line, which gives the same results as a run over a network
    family = fed_envs.load_family(checked.env or Path(str(checked.metadata)).absolute())
    overrides = {**checked.params, **({} if checked.n_rounds is None else {"n_rounds": checked.n_rounds})}
    settings = resolve(str(checked.algo), family, checked.conf, checked.env, overrides)
    model = settings.make(
        family,
        clients=[checked.client],
        seed=checked.seed,
        device=checked.device,
        num_threads=checked.num_threads,
        cache_dir=checked.cache_dir,
        verbose=0,
    )
    return model, settings.n_rounds
