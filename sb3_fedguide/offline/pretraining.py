"""The cached offline stage of a federation: data, behaviour cloning, action prior, DICE value.

Each piece is made at its first use and cached under the hash of all its inputs. Pieces of one client depend only on that
client's data and settings, and are cached per client; the trunk of the diffusion prior depends on all clients of the family.
"""

from __future__ import annotations

import copy
import dataclasses
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from fed_envs import Family, load_family
from sb3_fedguide.offline.behavior_cloning import clone
from sb3_fedguide.offline.cache import arrays_hash, cache_folder, cached_arrays, content_key, keep_arrays
from sb3_fedguide.offline.collect import check_source
from sb3_fedguide.offline.datasets import OfflineData, client_datasets, normalize_observations
from sb3_fedguide.offline.dice import DiceValue, train_dice
from sb3_fedguide.offline.progress import Progress, TqdmProgress, stage_progress
from sb3_fedguide.offline.trunk import TrunkTraining, federated_trunk
from sb3_fedguide.priors import DiffusionPrior, GaussianPrior, HeadStatistics, Prior
from sb3_fedguide.seeding import Role, stream
from sb3_fedguide.server.trunk import MOMENTS, TRUNK
from sb3_fedguide.settings.pretraining import Piece, PretrainingConfig, prior_is_gaussian
from sb3_fedguide.state.array_files import take_prefix
from sb3_fedguide.state.stacked import to_tensors

__all__ = ["PretrainedPrior", "Pretraining", "PretrainingConfig", "untrained_prior"]

VERSION = 1
"""Raised whenever the same inputs give other results, so that old cache entries are not taken for new ones."""

Arrays = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class PretrainedPrior:
    """The result of :meth:`Pretraining.prior`, clients in the order of ``client_ids``.

    :param prior: the frozen common part
    :param heads: ``(N, action_dim, p + 1)``, float32
    :param moments: ``(N, p + 1, p + 1)``, float64, the moments ``S_i`` of the score cost; they stay with their client
    :param statistics: the offline data's sufficient statistics of each head
    :param bytes_up: uploaded bytes of each client in the trunk's training
    :param bytes_down: bytes sent to each client
    """

    prior: Prior
    heads: np.ndarray
    moments: np.ndarray
    statistics: list[HeadStatistics]
    bytes_up: int
    bytes_down: int


class Pretraining:
    """The offline stage of some clients of a federation.

    :param family: a family's name, metadata file or object; ``None`` for the user's own environments
    :param client_ids: the clients in this process
    :param config: settings, default ``PretrainingConfig()``
    :param seed: the federation's seed
    :param cache_dir: default ``$FEDGUIDE_CACHE`` or ``~/.cache/fedguide``
    :param progress_bar: draw a bar per piece
    :param progress: called with ``(stage, done, total)`` instead
    :param env_spaces: observation and action space, checked against a given dataset; needed if ``family`` is ``None``
    :param trunk: the diffusion prior's trunk if it was trained elsewhere, as
        :meth:`sb3_fedguide.server.trunk.TrunkAverages.payload` gives it; otherwise all clients' data are needed here
    :raises ValueError: if there is neither a family nor a dataset
    """

    def __init__(
        self,
        family: str | Path | Family | None,
        client_ids: Sequence[int],
        config: PretrainingConfig | None = None,
        seed: int = 0,
        cache_dir: str | Path | None = None,
        progress_bar: bool = False,
        progress: Progress | None = None,
        env_spaces: tuple[spaces.Space, spaces.Space] | None = None,
        trunk: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        self.family = None if family is None else load_family(family)
        self.client_ids = list(client_ids)
        self.config = config or PretrainingConfig()
        self.seed = seed
        self.cache = cache_folder(cache_dir)
        self.env_spaces = env_spaces
        self._progress = progress if progress is not None else TqdmProgress() if progress_bar else None
        self._data: dict[int, OfflineData] = {}
        self._trunk: tuple[Prior, int, int] | None = None
        self._given_trunk = trunk

    def check_data(self) -> None:
        """:raises ValueError: if no offline data can be had, before anything is computed"""
        if self.config.dataset is not None:
            return
        if self.family is None:
            raise ValueError(
                "environments of your own bring no offline data: give a Minari dataset, pretraining={'dataset': "
                "'robots/arm{client}-v0'} (an id or a path; {client} stands for the client's number). `fedguide dataset` and "
                "sb3_fedguide.offline.make_dataset make one from logs and arrays (docs/extending.md)"
            )
        for client in self.client_ids:
            check_source(self.family, client)

    def datasets(self, client_ids: Sequence[int] | None = None) -> list[OfflineData]:
        """Offline data of the clients in this process, or of ``client_ids``.

        :raises ValueError: for a dataset that does not exist or fit, or the user's own environments without one
        """
        wanted = self.client_ids if client_ids is None else list(client_ids)
        missing = [client for client in wanted if client not in self._data]
        self.check_data()
        if missing:
            data = client_datasets(
                self.family,
                self.config.dataset_size,
                self.seed,
                self.cache,
                self.config.dataset,
                missing,
                env_spaces=self.env_spaces,
                progress=stage_progress(self._progress, "data"),
            )
            self._data.update(zip(missing, data, strict=True))
        return [self._data[client] for client in wanted]

    def behavior_cloning(self, actor: nn.Module, normalize: bool = True) -> dict[str, th.Tensor]:
        """The actors after behaviour cloning, theta_BC; ``actor`` itself is left as it is.

        :param actor: the initial actors, stacked: ``(N, batch, obs_dim)`` to mean actions ``(N, batch, action_dim)``
        :param normalize: observations are normalised by the moments of each client's own data
        :return: the parameters by name, ``(N, ...)`` each
        """
        data, config = self.datasets(), self.config
        initial = {name: tensor.detach().cpu().numpy() for name, tensor in actor.named_parameters()}
        structure = [
            type(module).__name__ if next(module.parameters(), None) is not None else repr(module)
            for module in actor.modules()
        ]
        keys = [
            self._client_key(
                index,
                "bc",
                normalize=normalize,
                structure=structure,
                initial=arrays_hash({name: array[index] for name, array in initial.items()}),
            )
            for index in range(len(data))
        ]

        def train(group: list[int], n_updates: int) -> list[Arrays]:
            actors = _take_clients(actor, group)
            observations = [
                normalize_observations(data[k].observations, *data[k].moments()) if normalize else data[k].observations
                for k in group
            ]
            clone(
                actors,
                observations,
                [data[k].actions for k in group],
                [stream(self.seed, Role.BEHAVIOR_CLONING, self.client_ids[k]) for k in group],
                n_updates,
                config.bc_batch_size,
                config.bc_learning_rate,
                progress=stage_progress(self._progress, "behaviour cloning"),
            )
            return [_client_arrays(actors.named_parameters(), k) for k in range(len(group))]

        entries = self._per_client("bc", keys, {name: array[0] for name, array in initial.items()}, train)
        return {name: th.from_numpy(np.stack([entry[name] for entry in entries])) for name in initial}

    def trunk(self) -> tuple[Prior, int, int]:
        """The common, frozen part of the priors, and the bytes that each client sent and received for it.

        All clients of the family take part, in any process: otherwise a client's prior would depend on its neighbours.
        """
        if self._trunk is None:
            prior = self.untrained_prior()
            if not isinstance(prior, DiffusionPrior):
                self._trunk = prior, 0, 0
            elif self._given_trunk is None:
                self._trunk = self._diffusion(prior)
            else:  # the process that trained it has counted the bytes
                self._trunk = _with_trunk(prior, self._given_trunk), 0, 0
        return self._trunk

    def untrained_prior(self) -> Prior:
        """The common part of the priors as it is before training, see :func:`untrained_prior`."""
        if self.env_spaces is not None:
            observations, actions = (space.shape[0] for space in self.env_spaces)  # type: ignore[index]
        else:
            data = self.datasets()[0]
            observations, actions = data.observations.shape[1], data.actions.shape[1]
        return untrained_prior(self.family, self.config, observations, actions, self.seed)

    def trunk_settings(self) -> dict[str, Any] | None:
        """The settings that all clients of a trunk's training must share; ``None`` if the prior has none."""
        return self.config.settings("prior") if isinstance(self.untrained_prior(), DiffusionPrior) else None

    def trunk_updates(self) -> list[int]:
        """Updates of the trunk for each client's data; the largest number counts."""
        return [self.config.n_updates("prior", len(rows)) for rows in self.datasets()]

    def trunk_training(self, mean: np.ndarray, std: np.ndarray, n_updates: int) -> TrunkTraining:
        """The trunk's training for the clients in this process.

        :param mean: of all clients' observations together, ``(obs_dim,)``; ``std`` likewise
        :param n_updates: of the whole training
        """
        prior = self.untrained_prior()
        assert isinstance(prior, DiffusionPrior)
        prior.set_observation_moments(mean, std)
        rngs = [stream(self.seed, Role.TRUNK, client) for client in self.client_ids]
        return TrunkTraining(
            prior, self.datasets(), rngs, n_updates, self.config.prior_batch_size, self.config.prior_learning_rate
        )

    def prior(self) -> PretrainedPrior:
        """The action priors: the common part, and each client's head fitted on its own data in closed form."""
        prior, bytes_up, bytes_down = self.trunk()
        data = self.datasets()
        common = arrays_hash({name: tensor.numpy() for name, tensor in prior.state_dict().items()})
        keys = [self._client_key(k, "prior", common=common, kind=type(prior).__name__) for k in range(len(data))]

        def entry(k: int) -> Arrays:
            rng = stream(self.seed, Role.HEAD, self.client_ids[k])
            statistics = prior.head_statistics(data[k].observations, data[k].actions, rng)
            moment = prior.feature_moment(data[k].observations, data[k].actions, rng)
            return {
                "head": prior.solve_head(statistics), "moment": moment, "gram": statistics.gram,
                "cross": statistics.cross, "weight": np.asarray(statistics.weight),
            }  # fmt: skip

        def fit(group: list[int], n_updates: int) -> list[Arrays]:
            return [entry(k) for k in group]

        square, action_dim = (prior.n_features + 1,) * 2, prior.action_dim
        expected: Arrays = {
            "head": np.zeros(prior.head_shape, dtype=np.float32), "moment": np.zeros(square), "gram": np.zeros(square),
            "cross": np.zeros((square[0], action_dim)), "weight": np.zeros(()),
        }  # fmt: skip
        entries = self._per_client("prior", keys, expected, fit)
        return PretrainedPrior(
            prior,
            np.stack([entry["head"] for entry in entries]),
            np.stack([entry["moment"] for entry in entries]),
            [HeadStatistics(entry["gram"], entry["cross"], float(entry["weight"])) for entry in entries],
            bytes_up,
            bytes_down,
        )

    def dice(self) -> DiceValue:
        """The clients' DICE values, stacked and frozen."""
        data, config = self.datasets(), self.config
        keys = [self._client_key(k, "dice", gamma=config.gamma) for k in range(len(data))]

        def train(group: list[int], n_updates: int) -> list[Arrays]:
            value = train_dice(
                [data[k] for k in group],
                [stream(self.seed, Role.DICE, self.client_ids[k]) for k in group],
                n_updates,
                config.dice_batch_size,
                config.dice_width,
                config.dice_omega,
                config.dice_learning_rate,
                config.gamma,
                tau=config.dice_tau,
                f=config.dice_f,
                v_coef=config.dice_v_coef,
                progress=stage_progress(self._progress, "DICE"),
            )
            return [_client_arrays(value.state_dict().items(), k) for k in range(len(group))]

        value = DiceValue(len(data), data[0].observations.shape[1], config.dice_width)
        entries = self._per_client("dice", keys, _client_arrays(value.state_dict().items(), 0), train)
        value.load_state_dict({name: th.from_numpy(np.stack([entry[name] for entry in entries])) for name in entries[0]})
        return value.requires_grad_(False)

    def _diffusion(self, prior: DiffusionPrior) -> tuple[Prior, int, int]:
        config = self.config
        everyone = range(self.family.n_clients) if self.family is not None else self.client_ids
        data = self.datasets(everyone)
        n_updates = max(config.n_updates("prior", len(rows)) for rows in data)
        key = content_key(
            version=VERSION, seed=self.seed, clients=list(everyone), data=[rows.content_hash for rows in data],
            architecture=prior.arguments, n_updates=n_updates, **config.settings("prior"),
        )  # fmt: skip

        def build() -> Arrays:
            trained = federated_trunk(
                prior,
                data,
                [stream(self.seed, Role.TRUNK, client) for client in everyone],
                n_updates,
                config.prior_average_every,
                config.prior_batch_size,
                config.prior_learning_rate,
                progress=stage_progress(self._progress, "prior"),
            )
            state = {f"state/{name}": tensor.cpu().numpy() for name, tensor in trained.prior.state_dict().items()}
            traffic = {"bytes_up": np.asarray(trained.upload_bytes), "bytes_down": np.asarray(trained.download_bytes)}
            return {**state, **traffic}

        expected = {f"state/{name}": tensor.numpy() for name, tensor in prior.state_dict().items()}
        expected |= {"bytes_up": np.asarray(0), "bytes_down": np.asarray(0)}
        arrays = cached_arrays(self.cache / "pretraining" / "trunk" / f"{key}.npz", build, expected)
        if arrays is None:
            raise RuntimeError("the trunk was neither cached nor built")
        state = {name: th.from_numpy(array) for name, array in arrays.items() if name.startswith("state/")}
        prior.load_state_dict({name.removeprefix("state/"): tensor for name, tensor in state.items()})
        return prior.requires_grad_(False), int(arrays["bytes_up"]), int(arrays["bytes_down"])

    def _client_key(self, index: int, piece: Piece, **more: Any) -> str:
        """Cache key of one client's part of a piece: its own data, settings and stream, nothing of other clients."""
        client = self.client_ids[index]
        data = self._data[client]
        return content_key(
            version=VERSION, piece=piece, seed=self.seed, client=client, data=data.content_hash,
            n_updates=self.config.n_updates(piece, len(data)), **self.config.settings(piece), **more,
        )  # fmt: skip

    def _per_client(
        self, piece: Piece, keys: Sequence[str], expected: Arrays, train: Callable[[list[int], int], list[Arrays]]
    ) -> list[Arrays]:
        """Every client's entry; those that are not cached are trained together, and each is stored by itself.

        :param expected: arrays with an entry's names, dtypes and shapes
        """
        paths = [self.cache / "pretraining" / piece / f"{key}.npz" for key in keys]
        entries: list[Arrays | None] = [cached_arrays(path, expected=expected) for path in paths]
        # In lockstep all train equally long, but clients differ in their number of updates: one group per number.
        groups: dict[int, list[int]] = defaultdict(list)
        for k, client in enumerate(self.client_ids):
            if entries[k] is None:
                groups[self.config.n_updates(piece, len(self._data[client]))].append(k)
        for n_updates, group in groups.items():
            for k, arrays in zip(group, train(group, n_updates), strict=True):
                keep_arrays(paths[k], arrays)
                entries[k] = arrays
        return [entry for entry in entries if entry is not None]


def untrained_prior(family: Family | None, config: PretrainingConfig, obs_dim: int, action_dim: int, seed: int) -> Prior:
    """The common part of the priors as it is before training, the same wherever it is made."""
    if prior_is_gaussian(config.prior, None if family is None else family.world):
        return GaussianPrior(obs_dim, action_dim)
    return DiffusionPrior(obs_dim, action_dim, width=config.prior_width, rng=stream(seed, Role.TRUNK))


def _with_trunk(prior: DiffusionPrior, trunk: Mapping[str, np.ndarray]) -> DiffusionPrior:
    """``prior`` with the moments and parameters of a trained trunk, frozen."""
    prior.set_observation_moments(trunk[f"{MOMENTS}mean"], trunk[f"{MOMENTS}std"])
    prior.trunk.load_state_dict(to_tensors(take_prefix(dict(trunk), TRUNK)))
    return prior.requires_grad_(False)


def _take_clients(module: nn.Module, indices: list[int]) -> nn.Module:
    """A copy of a stacked module, on the CPU, with only the clients at ``indices``."""
    taken = copy.deepcopy(module).cpu()
    for parameter in taken.parameters():
        parameter.data = parameter.data[indices].clone()
    return taken.requires_grad_(True)


def _client_arrays(named: Any, index: int) -> Arrays:
    return {name: tensor.detach()[index].cpu().numpy().copy() for name, tensor in named}
