"""Make a federation's environments, and check that they fit an existing model."""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from fed_envs import FederatedVecEnv
from sb3_fedguide.settings.argument_types import FederationLike, MaybeFederation

if TYPE_CHECKING:
    from fed_envs import Family


class FederatedEnvironments(BaseAlgorithm):
    """Mixin of a federation: matches its policies with the environments of their own clients.

    Environments of the same clients in another order are put into the model's order. A family's name, a metadata file or a
    list of factories has all of its clients: the model takes its own ones, with as many copies as before.
    """

    client_ids: list[int]
    n_envs_per_client: int
    family: Family | None
    rollout_size: int

    @abstractmethod
    def _fit_copies(self) -> None:
        """Make anew all arrays that depend on the number of environments per client, after it has changed."""

    @classmethod
    def load(  # type: ignore[override]  # one VecEnv of SB3's holds a single client
        cls,
        path: str | Path | io.BufferedIOBase,
        env: MaybeFederation = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Any:
        """As in SB3, whose archive is unpickled: it can execute any code, so load only archives that you trust.

        :meth:`import_parameters` safely reads a file of :meth:`export_parameters` from any source.

        :param env: environments of the same clients; a ``FederatedVecEnv`` may have another number of copies per client
        :raises ValueError: for environments of other clients or of another family, and for another version's archive
        """
        try:
            model = super().load(path, None, device, custom_objects, print_system_info, force_reset, **kwargs)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in ("sb3_fedguide", "fed_envs"):
                raise
            raise ValueError(
                f"{path} was saved by another version of this package, which has a module {error.name}; make a "
                f"{cls.__name__} with the same settings and call import_parameters() with the parameters.npz beside it"
            ) from error
        if env is not None:
            matching = model._matching(env)
            if matching.n_envs_per_client != model.n_envs_per_client:
                check_copies(model.rollout_size, matching.n_envs_per_client)
                model.n_envs_per_client, model.n_envs = matching.n_envs_per_client, matching.num_envs
                model._fit_copies()
            model.set_env(matching, force_reset)
            matching.seed(model.seed)
        return model

    def set_env(self, env: FederationLike, force_reset: bool = True) -> None:  # type: ignore[override]
        """Train in other environments of the same clients; otherwise as in SB3.

        :raises ValueError: for environments of other clients, of another family, or with another number of copies
        """
        matching = self._matching(env)
        if matching.n_envs_per_client != self.n_envs_per_client:
            raise ValueError(
                f"set_env() keeps the number of environments per client: {self.n_envs_per_client}, not "
                f"{matching.n_envs_per_client}; {type(self).__name__}.load(path, env=...) takes another"
            )
        super().set_env(matching, force_reset)
        self.family = matching.family

    def _matching(self, given: FederationLike) -> FederatedVecEnv:
        """``given`` with this model's clients in this model's order."""
        made = isinstance(given, VecEnv | gym.Env)
        env = as_federated_env(given) if made else as_federated_env(given, self.n_envs_per_client, self.client_ids)
        assert isinstance(env, FederatedVecEnv)
        own, theirs = _name(self.family), _name(env.family)
        if own != theirs:
            raise ValueError(
                f"the environments are of {theirs}, and this {type(self).__name__} is a federation of {own}: the policies of "
                "its clients would act in others' environments. To start from their parameters, make a new model of "
                "those environments, and use export_parameters() and import_parameters()"
            )
        if set(env.client_ids) != set(self.client_ids):
            raise ValueError(
                f"the environments are of the clients {env.client_ids}, and this {type(self).__name__} holds the clients "
                f"{self.client_ids}; make them with clients={self.client_ids}"
            )
        if (env.observation_space, env.action_space) != (self.observation_space, self.action_space):
            raise ValueError(
                f"the environments have the spaces {env.observation_space} and {env.action_space}, and this "
                f"{type(self).__name__} was made for {self.observation_space} and {self.action_space}"
            )
        return env if env.client_ids == self.client_ids else env.reordered(self.client_ids)

    @staticmethod
    def _wrap_env(env: Any, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        """Accept all forms of a federation's environments, also as SB3's ``env`` argument."""
        wrapped = as_federated_env(env)
        assert wrapped is not None
        return BaseAlgorithm._wrap_env(wrapped, verbose, monitor_wrapper)


def check_copies(rollout_size: int, n_envs_per_client: int) -> None:
    """:raises ValueError: if a round's steps cannot be divided among a client's environments"""
    if rollout_size < 1 or rollout_size % n_envs_per_client:
        raise ValueError(
            f"n_envs_per_client={n_envs_per_client} must divide rollout_size={rollout_size}, the steps per client and round"
        )


def as_federated_env(
    env: MaybeFederation,
    n_envs_per_client: int = 1,
    clients: Sequence[int] | None = None,
    num_threads: int = 1,
) -> FederatedVecEnv | None:
    """A ``FederatedVecEnv`` from a family name, metadata file, ``Family`` or list of factories.

    :raises ValueError: for an environment that holds a single client
    """
    if isinstance(env, FederatedVecEnv):
        for name, given, own in (
            ("clients", clients, env.client_ids),
            ("n_envs_per_client", n_envs_per_client if n_envs_per_client > 1 else None, env.n_envs_per_client),
            ("num_threads", num_threads if num_threads > 1 else None, env.num_threads),
        ):
            if given is not None and given != own:
                raise ValueError(f"{name}={given} does not fit the FederatedVecEnv, which has {own}: leave {name} out")
    if env is None or isinstance(env, FederatedVecEnv):
        return env
    if isinstance(env, VecEnv | gym.Env):
        hint = "; normalize=True does what VecNormalize does, for each client" if isinstance(env, VecNormalize) else ""
        raise ValueError(
            f"a federation needs one environment per client, but got a single {type(env).__name__}; pass a family name, "
            f"a metadata file, a fed_envs.FederatedVecEnv or a list of environment factories{hint}"
        )
    return FederatedVecEnv(env, n_envs_per_client=n_envs_per_client, clients=clients, num_threads=num_threads)


def _name(family: Family | None) -> str:
    """A name that distinguishes families."""
    return "functions of your own" if family is None else f"the family {family.name} ({family.content_hash[:12]})"
