"""Proximal policy optimisation of N clients in lockstep: one SB3 algorithm is a whole federation."""

from __future__ import annotations

import time
import warnings
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule

from fed_envs import FederatedVecEnv
from sb3_fedguide.common.distributions import action_distribution, check_continuous
from sb3_fedguide.common.environments import as_federated_env
from sb3_fedguide.common.faults import check_experience
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.common.keywords import check_policy, check_policy_keywords
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.participation import ParticipationAdam
from sb3_fedguide.common.ppo_policy import StackedMlpPolicy
from sb3_fedguide.common.rollout_buffer import FederatedRolloutBuffer, FederatedSamples, check_sizes, generalized_advantage
from sb3_fedguide.common.training_log import RoundStatistics, record_training
from sb3_fedguide.seeding import Role, integer_seed
from sb3_fedguide.settings.arguments import FederatedPPOArguments
from sb3_fedguide.settings.ranges import check_values
from sb3_fedguide.settings.signatures import takes, types_of
from sb3_fedguide.state.stacked import clip_grad_norm_per_client


class FederatedPPO(Federation, PPO):
    """PPO for every client of a family at once; the base class of every on-policy method.

    One rollout and one ``train()`` are one communication round. A method extends it with a few hooks: a server ``strategy``
    with ``upload`` and ``receive``, :meth:`_prepare_training`, :meth:`_extra_losses` and :meth:`_transform_gradients`.
    Without them, N clients learn exactly as N separate SB3 PPO runs.

    Paper: https://arxiv.org/abs/1707.06347 (PPO)

    :param policy: ``"MlpPolicy"``
    :param env: name of a family (``"HopperHard"``), path of a metadata file, a ``fed_envs.Family``, a
        ``fed_envs.FederatedVecEnv``, or a list with one environment factory per client
    :param learning_rate: as in SB3
    :param rollout_size: environment steps per client and round
    :param batch_size: minibatch size per client
    :param n_epochs: passes over the rollout
    :param gamma: discount factor
    :param gae_lambda: trace coefficient of GAE
    :param clip_range: as in SB3, like ``clip_range_vf``, ``normalize_advantage``, ``ent_coef`` and ``vf_coef``
    :param max_grad_norm: bound on each client's own gradient norm
    :param n_envs_per_client: environments per client; must divide ``rollout_size``
    :param clients: ids of the clients that live here; all by default
    :param num_threads: upper bound on the threads that step the simulators, see :class:`fed_envs.FederatedVecEnv`
    :param normalize: running normalisation of observations and rewards, as ``VecNormalize``, per client; with ``"shared"`` the
        clients pool their observation statistics through the server after every round
    :param bc_weight: alpha of ``theta_0 = (1 - alpha) theta_rand + alpha theta_BC`` for the actor (paper: 0.3)
    :param client_fraction: share of the clients that take part in each round, drawn by the server; the others keep all of
        their state, and receive the missed broadcast before they train again
    :param upload_bound: bound on norms of uploads above the clients' median, beyond which the server rejects them, see
        :func:`~sb3_fedguide.server.validation.check_uploads`; ``None`` leaves out all checks of uploads
    :param pretraining: settings of the offline stage, a ``PretrainingConfig`` or a dict of its fields
    :param cache_dir: folder of the offline stage's results; by default the user's cache folder
    :param stats_window_size: finished episodes per client over which returns are averaged
    :param tensorboard_log: as in SB3, like ``policy_kwargs``, ``verbose`` and ``device``
    :param seed: the federation's seed; drawn and stored if ``None``
    :raises ValueError: for settings that do not fit, with the remedy in the message
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = dict.fromkeys(FederatedPPOArguments.policies, StackedMlpPolicy)
    #: the algorithm whose settings a user's own algorithm takes if it has none
    base_settings: ClassVar[str | None] = "local"
    rollout_buffer: FederatedRolloutBuffer  # type: ignore[assignment]
    policy: StackedMlpPolicy

    @takes(FederatedPPOArguments)
    def __init__(self, given: FederatedPPOArguments) -> None:
        check_policy(given.policy, self.policy_aliases, type(self))
        env = as_federated_env(given.env, given.n_envs_per_client, given.clients, given.num_threads)
        self._init_federation(env, given)
        check_sizes(given.rollout_size, given.batch_size, self.n_envs_per_client)
        if env is not None:
            self._check_actions(env)
        self.rollout_size = given.rollout_size
        with warnings.catch_warnings():
            # SB3 treats the clients' rollouts as one and compares its size with a client's minibatch.
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            super().__init__(
                given.policy,  # type: ignore[arg-type]
                env,  # type: ignore[arg-type]
                learning_rate=given.learning_rate,
                n_steps=given.rollout_size // self.n_envs_per_client,
                batch_size=given.batch_size,
                n_epochs=given.n_epochs,
                gamma=given.gamma,
                gae_lambda=given.gae_lambda,
                clip_range=given.clip_range,
                clip_range_vf=given.clip_range_vf,
                normalize_advantage=given.normalize_advantage,
                ent_coef=given.ent_coef,
                vf_coef=given.vf_coef,
                max_grad_norm=given.max_grad_norm,
                stats_window_size=given.stats_window_size,
                tensorboard_log=given.tensorboard_log,
                policy_kwargs=given.policy_kwargs,
                verbose=given.verbose,
                seed=int(np.random.SeedSequence().generate_state(1)[0] >> 1) if given.seed is None else given.seed,
                device=given.device,
                _init_setup_model=False,
            )
        if given._init_setup_model:
            self._setup_model()

    def _check_actions(self, env: FederatedVecEnv) -> None:
        """:raises ValueError: if this method cannot learn the environments' kind of actions"""
        action_distribution(env.action_space)
        if self.uses_prior:
            instead = "use FedAvg, FedProx, FedKL, FedSVRPGM or Local"
            check_continuous(env.action_space, f"{type(self).__name__}'s prior over actions", instead)
        if self.bc_weight > 0:
            check_continuous(env.action_space, "behaviour cloning (bc_weight)", "leave bc_weight at 0")

    def _setup_model(self) -> None:
        assert self.seed is not None
        check_values(types_of(type(self)), vars(self))  # those of subclasses, and of load()
        check_policy_keywords(self.policy_class, self.policy_kwargs)
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        kwargs = {**self.policy_kwargs, "n_clients": self.n_clients, "init_seed": integer_seed(self.seed, Role.INIT)}
        if self.partial:
            kwargs.update(optimizer_class=ParticipationAdam, optimizer_kwargs={"eps": 1e-5})  # SB3's epsilon for Adam
        self.policy = self.policy_class(self.observation_space, self.action_space, self.lr_schedule, **kwargs).to(self.device)  # type: ignore
        self.clip_range: Schedule = FloatSchedule(self.clip_range)
        self.clip_range_vf: Schedule | None = None if self.clip_range_vf is None else FloatSchedule(self.clip_range_vf)
        self.normalizer = FederatedNormalizer(
            self.n_clients,
            self.n_envs_per_client,
            self.observation_space.shape[0],  # type: ignore[index]
            self.gamma,
            norm_obs=bool(self.normalize),
            norm_reward=bool(self.normalize),
            shared=self.normalize == "shared",
        )
        self._fit_copies()
        self._start_server()
        self._setup_state()

    def _fit_copies(self) -> None:
        check_sizes(self.rollout_size, self.batch_size, self.n_envs_per_client)
        self.n_steps = self.rollout_size // self.n_envs_per_client
        self.n_envs = self.n_clients * self.n_envs_per_client
        self.normalizer.reset_returns(self.n_envs_per_client)
        self.rollout_buffer = FederatedRolloutBuffer(
            self.n_steps,
            self.n_clients,
            self.n_envs_per_client,
            self.observation_space,  # type: ignore[arg-type]
            action_distribution(self.action_space).action_dim,
        )

    def _prepare_training(self) -> None:
        """After the rollout, before the first minibatch: compute what the extra losses need, once per round."""

    def _finish_training(self) -> None:
        """After the last minibatch."""

    def _extra_losses(self, data: FederatedSamples, mean: th.Tensor, log_prob: th.Tensor) -> dict[str, th.Tensor]:
        """Further loss terms by name, each ``(n_clients,)`` and already weighted.

        :param mean: the current policies' means, or logits of discrete actions, ``(n_clients, batch, n_outputs)``;
            ``self.policy.distribution`` computes densities and divergences from them
        :param log_prob: log-density of ``data.actions`` under the current policies, ``(n_clients, batch)``
        """
        return {}

    def _transform_gradients(self, data: FederatedSamples) -> None:
        """Change ``parameter.grad`` in place, before clipping."""

    def _train_round(self, callbacks: BaseCallback) -> bool:
        started = time.perf_counter()
        if not self.collect_rollouts(self.env, callbacks, self.rollout_buffer, self.n_steps):  # type: ignore[arg-type]
            return False
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        collected = time.perf_counter()
        self.train()
        self.logger.record("time/rollout", collected - started)
        self.logger.record("time/train", time.perf_counter() - collected)
        return True

    def collect_rollouts(  # type: ignore[override]
        self, env: FederatedVecEnv, callback: BaseCallback, rollout_buffer: FederatedRolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """One round's experience of every client; values and log-probabilities are computed in bulk at its end."""
        assert self._last_obs is not None and self._last_episode_starts is not None
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        shape = (self.n_clients, self.n_envs_per_client)
        distribution, noise = self.policy.distribution, self._exploration_noise(n_rollout_steps).unbind()
        actor_mean = self.policy.fixed_actor_mean()
        n_active = self._active_steps(env)
        raw_obs = self._last_obs.reshape(*shape, -1)  # type: ignore[union-attr]
        obs = self.normalizer.normalize_obs(raw_obs)
        starts = self._last_episode_starts.reshape(shape)
        present = None if self.present.all() else self.present
        for n_steps in range(n_rollout_steps):
            mean = actor_mean(th.as_tensor(obs, device=self.device))
            drawn = distribution.decide(mean + noise[n_steps]).cpu().numpy()
            actions = drawn.reshape(env.num_envs, *drawn.shape[2:])
            clipped_actions = distribution.executed(drawn)
            new_obs, rewards, dones, infos = env.step(clipped_actions)  # names as in SB3, whose callbacks read them
            self.num_timesteps += n_active
            callback.update_locals(locals())
            goes_on = callback.on_step()
            next_raw = new_obs.reshape(*shape, -1)  # type: ignore[union-attr]
            ends = dones.reshape(shape)
            self.normalizer.update_obs(next_raw, present)
            scaled_rewards = self.normalizer.scale_reward(rewards.reshape(shape), ends, present)
            rollout_buffer.add(raw_obs, obs, drawn, scaled_rewards, starts)
            for index in np.flatnonzero(dones):
                self._end_episode(int(index), infos[index])
            raw_obs, obs, starts = next_raw, self.normalizer.normalize_obs(next_raw), ends
            if present is not None:  # an absent client has not yet begun its episode
                starts = np.where(present[:, None], ends, rollout_buffer.episode_starts[n_steps] > 0)
            if not goes_on or n_steps + 1 == n_rollout_steps:  # the next rollout begins here, for any end of this one
                self._last_obs, self._last_episode_starts = new_obs, np.asarray(starts, dtype=bool).reshape(-1)  # type: ignore[assignment]
            if not goes_on:
                return False
        self._finish_rollout(raw_obs, obs, ends)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _exploration_noise(self, n_steps: int) -> th.Tensor:
        """Noise that turns the actors' outputs into samples, for a whole rollout, from each client's own stream.

        :return: ``(n_steps, n_clients, n_envs, n_outputs)``
        """
        distribution, log_std = self.policy.distribution, self.policy.log_std
        per_client = (n_steps, self.n_envs_per_client, distribution.n_outputs)
        draws = np.zeros((n_steps, self.n_clients, *per_client[1:]), dtype=np.float32)
        for index, rng in self.present_streams(Role.ACTION):
            draws[:, index] = distribution.noise(rng, per_client)
        if log_std is not None:
            draws *= log_std.detach().exp().cpu().numpy()[None, :, None]
        return th.as_tensor(draws, device=self.device)

    def _end_episode(self, index: int, info: dict[str, Any]) -> None:
        client, env = divmod(index, self.n_envs_per_client)
        self.note_episode(client, info)
        if info.get("TimeLimit.truncated", False):
            final = np.asarray(info["terminal_observation"])
            self.rollout_buffer.add_truncation(client, env, final, self.normalizer.normalize_obs(final, client))

    def _check_experience(self) -> None:
        buffer = self.rollout_buffer
        finals = np.zeros((buffer.pos, self.n_clients), dtype=bool)  # of truncated episodes, and of the rollout
        for step, client, _, final, _ in buffer.truncations:
            finals[step, client] |= not np.isfinite(final).all()
        finals[-1:] |= ~np.isfinite(self._last_obs).reshape(self.n_clients, -1).all(axis=1)  # type: ignore[arg-type]
        check_experience(
            self.client_ids,
            {
                "an observation": buffer.raw_observations[: buffer.pos],
                "a reward": buffer.rewards[: buffer.pos],
                "a final observation": np.where(finals, np.nan, 0.0),
            },
        )

    @th.no_grad()
    def _finish_rollout(self, raw_obs: np.ndarray, obs: np.ndarray, dones: np.ndarray) -> None:
        """Values, log-probabilities and advantages of the whole rollout."""
        self._check_experience()
        buffer = self.rollout_buffer
        rows = th.as_tensor(buffer.rows(buffer.observations), device=self.device)
        actions = th.as_tensor(buffer.rows(buffer.actions), device=self.device)
        log_probs = self.policy.distribution.log_prob(self.policy.actor_mean(rows), self.policy.log_std, actions)
        buffer.log_probs[:] = buffer.unrows(log_probs.cpu().numpy())
        buffer.values[:] = buffer.unrows(self.policy.values(rows).cpu().numpy())
        last_values = self.policy.values(th.as_tensor(obs, device=self.device)).cpu().numpy()
        self._compute_advantages(last_values, self._truncation_values(), raw_obs, dones)

    def _truncation_values(self) -> np.ndarray:
        """The critics' values of final observations of truncated episodes, in temporal order."""
        values = np.zeros(len(self.rollout_buffer.truncations), dtype=np.float32)
        for position, (_, client, _, _, obs) in enumerate(self.rollout_buffer.truncations):
            batch = np.zeros((self.n_clients, 1, len(obs)), dtype=np.float32)
            batch[client] = obs
            values[position] = self.policy.values(th.as_tensor(batch, device=self.device))[client, 0].item()
        return values

    def _compute_advantages(
        self, last_values: np.ndarray, truncation_values: np.ndarray, last_raw_obs: np.ndarray, dones: np.ndarray
    ) -> None:
        """GAE with the online critic, and its returns as the critic's targets."""
        buffer = self.rollout_buffer
        rewards = buffer.bootstrapped_rewards(self.gamma, truncation_values)
        buffer.advantages[:] = generalized_advantage(
            rewards, buffer.values, last_values, buffer.episode_starts, dones, self.gamma, self.gae_lambda
        )
        buffer.returns[:] = buffer.advantages + buffer.values

    def train(self) -> None:
        """SB3's PPO update for all clients at once: per-client losses, advantage normalisation and gradient clipping."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        clip_range = self.clip_range(self._current_progress_remaining)
        clip_range_vf = None if self.clip_range_vf is None else self.clip_range_vf(self._current_progress_remaining)
        parameters, distribution = list(self.policy.parameters()), self.policy.distribution
        statistics = RoundStatistics()
        self._prepare_training()
        for _ in range(self.n_epochs):
            for data in self.rollout_buffer.get(self.batch_size, self.present_streams(Role.MINIBATCH), self.device):
                mean = self.policy.actor_mean(data.observations)
                values = self.policy.values(data.observations)
                log_prob = distribution.log_prob(mean, self.policy.log_std, data.actions)
                entropy = distribution.entropy(mean, self.policy.log_std)

                advantages = data.advantages
                if self.normalize_advantage and advantages.shape[1] > 1:
                    centred = advantages - advantages.mean(dim=1, keepdim=True)
                    advantages = centred / (advantages.std(dim=1, keepdim=True) + 1e-8)
                log_ratio = log_prob - data.old_log_prob
                ratio = th.exp(log_ratio)
                clipped = th.clamp(ratio, 1 - clip_range, 1 + clip_range)
                # clipped surrogate (paper, Eq. 14; Schulman et al. 2017, Eq. 7)
                policy_loss = -th.min(advantages * ratio, advantages * clipped).mean(dim=1)
                if clip_range_vf is not None:
                    change = th.clamp(values - data.old_values, -clip_range_vf, clip_range_vf)
                    values = data.old_values + change
                value_loss = ((data.returns - values) ** 2).mean(dim=1)
                loss = policy_loss - self.ent_coef * entropy + self.vf_coef * value_loss
                extra_losses = self._extra_losses(data, mean, log_prob)
                for term in extra_losses.values():
                    loss = loss + term

                self.policy.optimizer.zero_grad()
                loss.sum().backward()
                self._transform_gradients(data)
                grad_norm = clip_grad_norm_per_client(parameters, self.max_grad_norm)
                self.policy.optimizer.step()
                with th.no_grad():
                    statistics.add(
                        policy_gradient_loss=policy_loss,
                        value_loss=value_loss,
                        entropy_loss=-entropy,
                        approx_kl=(ratio - 1 - log_ratio).mean(dim=1),
                        clip_fraction=((ratio - 1).abs() > clip_range).float().mean(dim=1),
                        grad_norm=grad_norm,
                        loss=loss,
                        **extra_losses,
                    )
            self._n_updates += 1
        self._finish_training()
        record_training(self, statistics, {"clip_range": self.clip_range, "clip_range_vf": self.clip_range_vf})
