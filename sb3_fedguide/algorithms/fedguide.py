"""FedGuide: clients learn by PPO, guided by a mixture of behaviour priors that the server routes by optimal transport."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch as th

from fed_envs.state import State
from sb3_fedguide.algorithms.fedguide_parts import begin_parts, offline_parts, part_arrays, set_part_arrays
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.parameter_averaging import ParameterAveraging
from sb3_fedguide.common.rollout_buffer import FederatedSamples, generalized_advantage
from sb3_fedguide.common.value_blend import baseline_metrics, optimal_blend
from sb3_fedguide.offline.dice import DiceValue, calibrate
from sb3_fedguide.offline.pretraining import Pretraining
from sb3_fedguide.priors.adaptation import HeadAdaptation
from sb3_fedguide.priors.base import Prior, score_cost
from sb3_fedguide.priors.importance import importance_weights
from sb3_fedguide.priors.mixture import mixture_log_prob, mixture_sample
from sb3_fedguide.seeding import Role
from sb3_fedguide.server.ot_moe import COST_ROW, EXPERTS, HEAD, MIXTURE_ROW
from sb3_fedguide.server.strategy import Payload
from sb3_fedguide.settings.arguments import FederatedPPOArguments, FedGuideAArguments, FedGuideArguments
from sb3_fedguide.settings.signatures import takes
from sb3_fedguide.state.stacked import to_arrays, to_tensors

#: Raw actions further outside the action box than this get no importance weight: no behaviour data can lie there.
ACTION_MARGIN = 0.1


class FedGuide(FederatedPPO):
    """Federated policy optimisation guided by distribution-space priors and an offline value baseline.

    Every client regularises PPO towards its personal prior, a mixture of diffusion priors (paper, Eq. 10),
    and computes advantages from a blend of its critic and a frozen DICE value (Eq. 12). Only the linear head of the
    client's prior and its row of transport costs leave it. Round by round the loss is

    ``L = PPO + vf_coef * MSE(V) + lambda_trust * KL(pi_old || pi) + lambda_prior(h) * R_prior``.

    Paper: FedGuide (see ``docs/fedguide.md`` for where this implementation decides otherwise)

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
        recent rollouts weighted by ``exp(A / adapt_temperature)``, so that what a client learns online reaches the others
    :param adapt_temperature: temperature of these weights, in standard deviations of the advantage
    :param adapt_weight: share of the recent rollouts in the refit, in [0, 1]

    All other parameters are those of :class:`FederatedPPO`.
    """

    uses_prior = True
    uses_dice: ClassVar[bool] = True
    state_attributes: ClassVar[tuple[str, ...]] = (
        "heads", "score_moments", "experts", "mixture_rows", "dice_scale", "calibrated",
    )  # fmt: skip
    shared_state = ("parts", "modules.prior")

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
        self.prior: Prior | None = None
        self.dice: DiceValue | None = None
        self.dice_scale: np.ndarray | None = None  # (n_clients, 2): a and b of the calibration
        self.adaptation: HeadAdaptation | None = None
        self.experts: np.ndarray | None = None  # what each client last received, (n_clients, n_experts, ...)
        super().__init__(**given.of(FederatedPPOArguments))

    def upload(self, index: int) -> Payload:
        payload: Payload = {HEAD: self.heads[index]}
        if self.cost == "score" and self.experts is not None:
            row = score_cost(self.heads[index], self.experts[index], self.score_moments[index])
            payload[COST_ROW] = row.astype(np.float32)
        return payload

    def receive(self, index: int, broadcast: Payload) -> None:
        if self.experts is None:
            self.experts = np.zeros((self.n_clients, *broadcast[EXPERTS].shape), dtype=np.float32)
            self.mixture_rows = np.full((self.n_clients, len(broadcast[EXPERTS])), np.nan, dtype=np.float32)
        self.experts[index] = broadcast[EXPERTS]
        if MIXTURE_ROW in broadcast:
            self.mixture_rows[index] = broadcast[MIXTURE_ROW]

    def upload_shapes(self) -> dict[str, list[int]]:
        return {HEAD: list(self.offline_stage().untrained_prior().head_shape)}

    def _pretrain(self, stage: Pretraining) -> None:
        fitted = stage.prior()
        self.prior = fitted.prior
        self.pretraining_bytes = (fitted.bytes_up * self.n_clients, fitted.bytes_down * self.n_clients)
        self.heads = fitted.heads  # psi_i, (n_clients, action_dim, p + 1)
        self.score_moments = fitted.moments  # S_i of the score cost; stay with their client
        if self.adapt == "advantage":
            self.adaptation = HeadAdaptation(fitted.statistics, self.adapt_weight, self.adapt_temperature)
        if self.uses_dice:
            self.dice = stage.dice()

    def save_state(self) -> State:
        modules = {name: module and to_arrays(module.state_dict()) for name, module in self._frozen_modules().items()}
        adaptation = self.adaptation and self.adaptation.save_state()
        return {**super().save_state(), "parts": offline_parts(self), "modules": modules, "adaptation": adaptation}

    def load_state(self, state: State) -> None:
        begin_parts(self, state["parts"], state["attributes"]["pretrained"])
        for name, module in self._frozen_modules().items():
            if module is not None:
                module.load_state_dict(to_tensors(state["modules"][name]))
        if self.adaptation is not None:
            self.adaptation.load_state(state["adaptation"])
        super().load_state(state)

    def _frozen_modules(self) -> dict[str, th.nn.Module | None]:
        return {"prior": self.prior, "dice": self.dice}

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
        self._begin_calibration()
        if self.dice_scale is not None:
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

    def complete_state(self) -> None:
        super().complete_state()
        self._begin_calibration()

    def _begin_calibration(self) -> None:
        if self.dice is not None and self.calibrate and self.dice_scale is None:
            self.dice_scale = np.tile([1.0, 0.0], (self.n_clients, 1))
            self.calibrated = np.zeros(self.n_clients, dtype=bool)

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
        assert self.prior is not None and self.experts is not None
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
        assert self.prior is not None and self.experts is not None
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
        if self.adaptation is None:
            return
        assert self.prior is not None
        buffer = self.rollout_buffer
        raw, advantages = buffer.rows(buffer.raw_observations), buffer.rows(buffer.advantages)
        executed = np.clip(buffer.rows(buffer.actions), self.action_space.low, self.action_space.high)  # type: ignore
        moved = np.zeros(self.n_clients)
        for i, rng in self.present_streams(Role.HEAD):
            head = self.adaptation.refit(self.prior, i, raw[i], executed[i], advantages[i], rng)
            moved[i] = np.linalg.norm(head - self.heads[i]) / np.linalg.norm(self.heads[i])
            self.heads[i] = head
        self.logger.record("prior/head_change", float(moved[self.present].mean()))

    def parameter_parts(self) -> list[str]:
        return offline_parts(self)

    def begin_parts(self, parts: Sequence[str], pretrained: bool) -> None:
        begin_parts(self, parts, pretrained)

    def parameter_arrays(self) -> dict[str, np.ndarray]:
        return {**super().parameter_arrays(), **part_arrays(self)}

    def set_parameter_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        super().set_parameter_arrays(arrays)
        set_part_arrays(self, arrays)


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
