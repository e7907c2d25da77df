"""FedGuide: clients learn by PPO, guided by a mixture of behaviour priors that the server routes by optimal transport."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch as th

from sb3_fedguide.common.anchors import Parameters
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.common.rollout_buffer import FederatedSamples, generalized_advantage
from sb3_fedguide.common.value_blend import baseline_metrics, optimal_blend
from sb3_fedguide.offline.dice import DiceValue, calibrate
from sb3_fedguide.offline.pretraining import Pretraining, untrained_prior
from sb3_fedguide.priors.base import HeadStatistics, Prior, score_cost
from sb3_fedguide.priors.importance import importance_weights
from sb3_fedguide.priors.mixture import mixture_log_prob, mixture_sample
from sb3_fedguide.priors.refit import refit_head
from sb3_fedguide.seeding import Role
from sb3_fedguide.server.ot_moe import COST_ROW, EXPERTS, HEAD, MIXTURE_ROW
from sb3_fedguide.server.strategy import Payload
from sb3_fedguide.settings.arguments import FederatedPPOArguments, FedGuideAArguments, FedGuideArguments
from sb3_fedguide.settings.signatures import takes
from sb3_fedguide.state.held import Held

#: Raw actions that lie further outside the action box get no importance weight: behaviour data cannot lie there.
ACTION_MARGIN = 0.1


class FedGuide(FederatedPPO):
    """Federated policy optimisation guided by distribution-space priors and an offline value baseline.

    Every client regularises PPO towards its personal prior, a mixture of diffusion priors (paper, Eq. 10),
    and computes advantages from a blend of its critic and a frozen DICE value (Eq. 12). Only the linear head of the
    client's prior and its row of transport costs leave the client. The loss of a round is

    ``L = PPO + vf_coef * MSE(V) + lambda_trust * KL(pi_old || pi) + lambda_prior(h) * R_prior``.

    Paper: FedGuide (``docs/fedguide.md`` lists the differences of this implementation)

    :param lambda_trust: lambda_1, weight of the exact Gaussian trust-region term
    :param lambda_prior: lambda_2, weight of the prior term in the first round
    :param prior_horizon: H_lambda2, rounds over which ``lambda_prior`` falls linearly to zero
    :param prior_loss: ``"snis"``, self-normalised importance weights on the rollout's actions (the paper's estimator), or
        ``"sample"``, actions drawn from the prior once per round: the same target without weights
    :param prior_states: states per client and round at which ``"snis"`` evaluates densities; ``None`` for all
    :param density_steps: Runge-Kutta steps of a density evaluation
    :param sampling_steps: denoising steps of a sample
    :param beta: weight of the online critic in the blended baseline: a number, a schedule of the remaining progress, or
        ``"auto"``, the variance-optimal weight of the paper's Lemma 2 estimated from the rollout
    :param critic_target: the critic learns the return of its ``"online"`` GAE or of the ``"blend"``
    :param calibrate: fit the DICE value to the first rollout's returns, ``G ~ a V + b``
    :param n_experts: M, experts at the server; as many as clients by default
    :param eta: entropic regularisation of the transport plan
    :param cost: transport cost, ``"score"`` or ``"param"`` (see :class:`~sb3_fedguide.server.ot_moe.OTMoE`)
    :param cost_scaling: ``"max"`` or ``"median"``
    :param adapt: ``"none"`` keeps the pretrained head; ``"advantage"`` refits it after each round on the offline data and
        recent rollouts weighted by ``exp(A / adapt_temperature)``, so that a client's online learning reaches the others
    :param adapt_temperature: temperature of these weights, in standard deviations of the advantage
    :param adapt_weight: share of the recent rollouts in the refit, in [0, 1]

    All other parameters are those of :class:`FederatedPPO`.
    """

    uses_prior = True
    uses_dice: ClassVar[bool] = True
    state_attributes: ClassVar[tuple[str | Held, ...]] = (
        Held("prior", shared=True, part="prior", file="prior/trunk/"),
        Held("heads", part="prior", file="prior/heads"),
        Held("score_moments", part="prior", file="prior/moments"),
        Held("offline_statistics", part="adaptation", file="prior/"),
        Held("recent_statistics", part="adaptation"),
        Held("dice", part="dice", file="dice/"),
        Held("experts", part="experts", file="prior/experts", later=True),
        Held("mixture_rows", part="experts", file="prior/mixture_rows", later=True),
        Held("dice_scale", part="calibration", file="dice_scale", later=True),
        Held("calibrated", part="calibration", file="dice_calibrated", later=True),
    )
    prior: Prior
    heads: np.ndarray  # psi_i, (n_clients, action_dim, p + 1)
    score_moments: np.ndarray  # S_i of the score cost, (n_clients, p + 1, p + 1); stay with their client
    experts: np.ndarray  # last received by each client, (n_clients, n_experts, action_dim, p + 1); NaN before
    mixture_rows: np.ndarray  # R_i, (n_clients, n_experts); NaN before the first plan
    dice: DiceValue | None
    dice_scale: np.ndarray | None  # (n_clients, 2): a and b of the calibration
    calibrated: np.ndarray | None  # (n_clients,) bool
    offline_statistics: Parameters | None  # of each client's head, by the fields of HeadStatistics
    recent_statistics: Parameters | None

    @takes(FedGuideArguments)
    def __init__(self, given: FedGuideArguments) -> None:
        self.lambda_trust = given.lambda_trust
        self.lambda_prior = given.lambda_prior
        self.prior_horizon = given.prior_horizon
        self.prior_loss = given.prior_loss
        self.prior_states = given.prior_states
        self.density_steps = given.density_steps
        self.sampling_steps = given.sampling_steps
        self.beta = given.beta
        self.critic_target = given.critic_target
        self.calibrate = given.calibrate
        self.n_experts = given.n_experts
        self.eta = given.eta
        self.cost = given.cost
        self.cost_scaling = given.cost_scaling
        self.adapt = given.adapt
        self.adapt_temperature = given.adapt_temperature
        self.adapt_weight = given.adapt_weight
        super().__init__(**given.of(FederatedPPOArguments))

    def _setup_state(self) -> None:
        super()._setup_state()
        adapts, calibrates = self.adapt == "advantage", self.uses_dice and self.calibrate
        if adapts and self.pretrained and vars(self).get("offline_statistics") is None:
            raise ValueError(
                "adapt='advantage' refits heads on the offline data too, and this model went through the offline stage with "
                "adapt='none', which keeps nothing of them; make a new model with adapt='advantage', or leave it at 'none'"
            )
        n = self.n_clients
        self.hold(
            prior=self._untrained_prior,
            heads=lambda: np.zeros((n, *self.prior.head_shape), dtype=np.float32),
            score_moments=lambda: np.zeros((n, *self._gram_shape)),
            offline_statistics=self._no_statistics if adapts else None,
            recent_statistics=(lambda: {**self._no_statistics(), "weight": np.zeros(n)}) if adapts else None,
            dice=self._untrained_dice if self.uses_dice else None,
            experts=lambda: self._no_experts(self.n_experts or n),
            mixture_rows=lambda: np.full((n, self.n_experts or n), np.nan, np.float32),
            dice_scale=(lambda: np.tile([1.0, 0.0], (n, 1))) if calibrates else None,
            calibrated=(lambda: np.zeros(n, dtype=bool)) if calibrates else None,
        )

    def _untrained_prior(self) -> Prior:
        assert self.seed is not None
        (obs_dim,), (action_dim,) = self.observation_space.shape, self.action_space.shape  # type: ignore[misc]
        return untrained_prior(self.family, self.pretraining_config, obs_dim, action_dim, self.seed)

    def _untrained_dice(self) -> DiceValue:
        (obs_dim,) = self.observation_space.shape  # type: ignore[misc]
        return DiceValue(self.n_clients, obs_dim, self.pretraining_config.dice_width).requires_grad_(False)

    @property
    def _gram_shape(self) -> tuple[int, int]:
        return (self.prior.n_features + 1,) * 2

    def _no_statistics(self) -> Parameters:
        """Of a head that has seen no data, by the fields of HeadStatistics but for the weight."""
        gram, cross = self._gram_shape, self.prior.head_shape[::-1]
        return {"gram": np.zeros((self.n_clients, *gram)), "cross": np.zeros((self.n_clients, *cross))}

    def _no_experts(self, n_experts: int) -> np.ndarray:
        """Experts of clients that have received none."""
        return np.full((self.n_clients, n_experts, *self.prior.head_shape), np.nan, np.float32)

    def upload(self, index: int) -> Payload:
        payload: Payload = {HEAD: self.heads[index]}
        if self.cost == "score" and not np.isnan(self.experts[index]).all():
            row = score_cost(self.heads[index], self.experts[index], self.score_moments[index])
            payload[COST_ROW] = row.astype(np.float32)
        return payload

    def receive(self, index: int, broadcast: Payload) -> None:
        n_experts = len(broadcast[EXPERTS])
        if n_experts != self.mixture_rows.shape[1]:  # a site does not know how many the server has
            self.experts = self._no_experts(n_experts)
            self.mixture_rows = np.full((self.n_clients, n_experts), np.nan, np.float32)
        self.experts[index] = broadcast[EXPERTS]
        if MIXTURE_ROW in broadcast:
            self.mixture_rows[index] = broadcast[MIXTURE_ROW]

    def upload_shapes(self) -> dict[str, list[int]]:
        return {HEAD: list(self.offline_stage().untrained_prior().head_shape)}

    def _pretrain(self, stage: Pretraining) -> None:
        fitted = stage.prior()
        self.prior = fitted.prior
        self.pretraining_bytes = (fitted.bytes_up * self.n_clients, fitted.bytes_down * self.n_clients)
        self.heads, self.score_moments = fitted.heads, fitted.moments
        if self.offline_statistics is not None:
            for i, statistics in enumerate(fitted.statistics):
                for name, array in self.offline_statistics.items():
                    array[i] = getattr(statistics * (1.0 / statistics.weight), name)
        if self.uses_dice:
            self.dice = stage.dice()

    def _compute_advantages(
        self, last_values: np.ndarray, truncation_values: np.ndarray, last_raw_obs: np.ndarray, dones: np.ndarray
    ) -> None:
        super()._compute_advantages(last_values, truncation_values, last_raw_obs, dones)
        if self.dice is None:
            return
        buffer = self.rollout_buffer
        rewards = buffer.bootstrapped_rewards(self.gamma, truncation_values)
        monte_carlo = buffer.values + generalized_advantage(
            rewards, buffer.values, last_values, buffer.episode_starts, dones, self.gamma, 1.0
        )
        returns = buffer.rows(monte_carlo)
        raw = buffer.rows(buffer.raw_observations)
        if self.dice_scale is not None and self.calibrated is not None:
            for i in np.flatnonzero(self.present & ~self.calibrated).tolist():
                std = self.normalizer.reward_std[i]
                self.dice_scale[i] = calibrate(self.dice.client_values(i, raw[i]) / std, returns[i])
                self.calibrated[i] = True
        dice = np.stack([self._dice_values(i, raw[i]) for i in range(self.n_clients)])
        online = buffer.rows(buffer.values)
        beta = self._blend_weights(returns, online, dice)

        blended = buffer.unrows(beta[:, None] * online + (1 - beta)[:, None] * dice)  # Eq. 12
        dice_last = np.stack([self._dice_values(i, last_raw_obs[i]) for i in range(self.n_clients)])
        blended_last = beta[:, None] * last_values + (1 - beta)[:, None] * dice_last
        blended_truncations = np.array(
            [
                beta[client] * value + (1 - beta[client]) * self._dice_values(client, final[None])[0]
                for (_, client, _, final, _), value in zip(buffer.truncations, truncation_values, strict=True)
            ],
            dtype=np.float32,
        )
        buffer.advantages[:] = generalized_advantage(  # Eq. 13
            buffer.bootstrapped_rewards(self.gamma, blended_truncations),
            blended.astype(np.float32),
            blended_last.astype(np.float32),
            buffer.episode_starts,
            dones,
            self.gamma,
            self.gae_lambda,
        )
        if self.critic_target == "blend":
            buffer.returns[:] = buffer.advantages + blended
        figures = {"beta": beta, **baseline_metrics(returns, online, dice, buffer.rows(blended))}
        for name, per_client in figures.items():
            self.logger.record(f"dice/{name}", float(per_client[self.present].mean()))
        for index in np.flatnonzero(self.present):
            for name in ("residual_correlation", "explained_variance_dice"):
                self.record_client(self.client_ids[index], name, float(figures[name][index]))

    def _dice_values(self, index: int, raw_obs: np.ndarray) -> np.ndarray:
        """V_phi of one client at raw observations ``(batch, obs_dim)``, in the scale of its rewards, ``(batch,)``."""
        assert self.dice is not None
        values = self.dice.client_values(index, raw_obs) / self.normalizer.reward_std[index]
        if self.dice_scale is not None:
            values = self.dice_scale[index, 0] * values + self.dice_scale[index, 1]
        return values.astype(np.float32)

    def _blend_weights(self, returns: np.ndarray, online: np.ndarray, dice: np.ndarray) -> np.ndarray:
        """beta of each client, ``(n_clients,)``; arguments ``(n_clients, n_rows)``."""
        if self.beta == "auto":
            return optimal_blend(returns, online, dice).astype(np.float32)
        beta = self.beta(self._current_progress_remaining) if callable(self.beta) else self.beta
        return np.full(self.n_clients, beta, dtype=np.float32)

    def prior_weight(self, round: int) -> float:
        """lambda_2(h), counted from h = 0."""
        return self.lambda_prior * max(0.0, 1.0 - round / self.prior_horizon)

    @th.no_grad()
    def _prepare_training(self) -> None:
        buffer = self.rollout_buffer
        self._prior_weight = self.prior_weight(self.round)
        if self.lambda_trust > 0:
            observations = th.as_tensor(buffer.rows(buffer.observations), device=self.device)
            buffer.extras["old_mean"] = self.policy.actor_mean(observations)
            self._old_log_std = self.policy.log_std.detach().clone()
        self.logger.record("prior/lambda_prior", self._prior_weight)
        if self._prior_weight > 0:
            if self.prior_loss == "snis":
                self._prepare_importance_weights()
            else:
                self._prepare_prior_actions()

    def _prepare_importance_weights(self) -> None:
        """Self-normalised weights of the rollout's actions under the mixture, with mean one over the whole rollout."""
        buffer = self.rollout_buffer
        raw, actions = buffer.rows(buffer.raw_observations), buffer.rows(buffer.actions)
        policy_log_probs = buffer.rows(buffer.log_probs)
        bound = np.maximum(np.abs(self.action_space.low), np.abs(self.action_space.high)) + ACTION_MARGIN  # type: ignore
        weights = np.zeros((self.n_clients, buffer.n_rows), dtype=np.float32)
        n_states = min(self.prior_states or buffer.n_rows, buffer.n_rows)
        sizes = []
        for i, rng in self.present_streams(Role.PRIOR):
            chosen = np.sort(rng.choice(buffer.n_rows, n_states, replace=False))
            visited = th.as_tensor(raw[i, chosen]), th.as_tensor(actions[i, chosen])
            mixture = self.prior, self.experts[i], self.mixture_rows[i]
            log_prior = mixture_log_prob(*mixture, *visited, n_steps=self.density_steps).numpy()
            supported = (np.abs(actions[i, chosen]) <= bound).all(axis=1)
            drawn, size = importance_weights(log_prior - policy_log_probs[i, chosen], supported)
            weights[i, chosen] = drawn * (buffer.n_rows / n_states)
            sizes.append(size / n_states)
            self.record_client(self.client_ids[i], "effective_sample_share", sizes[-1])
        buffer.extras["prior_weights"] = th.as_tensor(weights, device=self.device)
        self.logger.record("prior/effective_sample_share", float(np.mean(sizes)))
        self.logger.record("prior/effective_sample_share_min", float(np.min(sizes)))

    def _prepare_prior_actions(self) -> None:
        """One action per visited state from the mixture."""
        raw = self.rollout_buffer.rows(self.rollout_buffer.raw_observations)
        drawn = th.zeros(self.n_clients, self.rollout_buffer.n_rows, self.action_space.shape[0])  # type: ignore[index]
        for i, rng in self.present_streams(Role.PRIOR):
            drawn[i] = mixture_sample(
                self.prior, self.experts[i], self.mixture_rows[i], th.as_tensor(raw[i]), rng, n_steps=self.sampling_steps
            )
        low, high = th.as_tensor(self.action_space.low), th.as_tensor(self.action_space.high)  # type: ignore[attr-defined]
        self.rollout_buffer.extras["prior_actions"] = th.clamp(drawn, low, high).to(self.device)

    def _extra_losses(self, data: FederatedSamples, mean: th.Tensor, log_prob: th.Tensor) -> dict[str, th.Tensor]:
        losses = {}
        if self.lambda_trust > 0:
            old = data.extras["old_mean"], self._old_log_std
            # Eq. 11, first regulariser: KL(pi_old || pi)
            kl = self.policy.distribution.kl_divergence(*old, mean, self.policy.log_std)
            losses["trust_loss"] = self.lambda_trust * kl.mean(dim=1)
        if "prior_weights" in data.extras:
            # Eq. 11, prior regulariser: E_{a ~ prior}[-log pi(a | s)] by self-normalised importance weights
            cross_entropy = -(data.extras["prior_weights"] * log_prob).mean(dim=1)
            losses["prior_loss"] = self._prior_weight * cross_entropy
        elif "prior_actions" in data.extras:
            prior_log_prob = self.policy.distribution.log_prob(mean, self.policy.log_std, data.extras["prior_actions"])
            losses["prior_loss"] = -self._prior_weight * prior_log_prob.mean(dim=1)
        return losses

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_old_log_std"]

    def _finish_training(self) -> None:
        if self.offline_statistics is None or self.recent_statistics is None:
            return
        buffer = self.rollout_buffer
        raw, advantages = buffer.rows(buffer.raw_observations), buffer.rows(buffer.advantages)
        executed = np.clip(buffer.rows(buffer.actions), self.action_space.low, self.action_space.high)  # type: ignore
        moved = np.zeros(self.n_clients)
        for i, rng in self.present_streams(Role.HEAD):
            offline = HeadStatistics(**{name: array[i] for name, array in self.offline_statistics.items()}, weight=1.0)
            recent = HeadStatistics(**{name: array[i] for name, array in self.recent_statistics.items()})
            head, recent = refit_head(
                self.prior, offline, recent, self.adapt_weight, self.adapt_temperature, raw[i], executed[i], advantages[i], rng
            )
            for name, array in self.recent_statistics.items():
                array[i] = getattr(recent, name)
            moved[i] = np.linalg.norm(head - self.heads[i]) / np.linalg.norm(self.heads[i])
            self.heads[i] = head
        self.logger.record("prior/head_change", float(moved[self.present].mean()))


class FedGuideP(FedGuide):
    """FedGuide-P: the prior without the DICE value, ``beta = 1``. Parameters are those of :class:`FedGuide`."""

    uses_dice: ClassVar[bool] = False


class FedGuideA(ParameterAveraging, FedGuide):
    """FedGuide-A: FedGuide whose actors (with ``log_std``) are averaged every few rounds; critics stay local.

    Parameters are those of :class:`~sb3_fedguide.common.parameter_averaging.ParameterAveraging`, with other defaults, and of
    :class:`FedGuide`.
    """

    @takes(FedGuideAArguments)
    def __init__(self, given: FedGuideAArguments) -> None:
        super().__init__(**vars(given))
