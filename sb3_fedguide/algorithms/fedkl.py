"""FedKL: federated averaging with penalties on leaving the broadcast policy and the policy of the rollout."""

from __future__ import annotations

import torch as th

from sb3_fedguide.algorithms.fedprox import AnchoredFedAvg
from sb3_fedguide.common.anchors import actor_at
from sb3_fedguide.common.rollout_buffer import FederatedSamples
from sb3_fedguide.settings.arguments import FedAvgArguments, FedKLArguments
from sb3_fedguide.settings.signatures import takes


class FedKL(AnchoredFedAvg):
    """FedAvg whose clients minimise ``L_PPO + lambda_global * KL(pi || pi_bar) + lambda_local * KL(pi || pi_old)``.

    ``pi_bar`` is the last broadcast policy and ``pi_old`` the policy at the start of the round, both at the client's own
    states; the divergences are exact, averaged over states. With an average after every round the two policies are the
    same, and the weights add up. The two policies differ if ``average_every > 1``, or after ``average_until``. With both
    weights zero, FedKL is FedAvg.

    Weights and directions are those of the FedGuide paper's baseline. The original penalises ``sqrt(KL(pi_bar || pi))``
    and ``KL(pi_old || pi)``, minimises by SGD and adapts the weights.

    Paper: https://arxiv.org/abs/2204.08125

    :param lambda_global: weight of the divergence from the broadcast policy
    :param lambda_local: weight of the divergence from the policy of the rollout
    :raises ValueError: for negative weights, and if no policy is averaged

    All other parameters are those of :class:`FedAvg`.
    """

    @takes(FedKLArguments)
    def __init__(self, given: FedKLArguments) -> None:
        if given.average == "critic":
            raise ValueError("FedKL needs a broadcast policy, and average='critic' broadcasts none; use 'all' or 'actor'")
        self.lambda_global = given.lambda_global
        self.lambda_local = given.lambda_local
        self._log_stds: dict[str, th.Tensor | None] = {}
        super().__init__(**given.of(FedAvgArguments))

    @th.no_grad()
    def _prepare_training(self) -> None:
        buffer = self.rollout_buffer
        observations = th.as_tensor(buffer.rows(buffer.observations), device=self.device)
        if self.lambda_global > 0:
            actor, tensors = actor_at(self.policy, self.anchor)
            buffer.extras["broadcast_mean"] = actor(observations)
            self._log_stds["broadcast"] = None if self.policy.log_std is None else tensors["log_std"].detach()
        if self.lambda_local > 0:
            buffer.extras["old_mean"] = self.policy.actor_mean(observations)
            self._log_stds["old"] = None if self.policy.log_std is None else self.policy.log_std.detach().clone()

    def _extra_losses(self, data: FederatedSamples, mean: th.Tensor, log_prob: th.Tensor) -> dict[str, th.Tensor]:
        losses = {}
        for name, key, weight in (
            ("global_kl_loss", "broadcast", self.lambda_global),
            ("local_kl_loss", "old", self.lambda_local),
        ):
            if weight > 0:
                other = data.extras[f"{key}_mean"], self._log_stds[key]
                kl = self.policy.distribution.kl_divergence(mean, self.policy.log_std, *other)
                losses[name] = weight * kl.mean(dim=1)
        return losses

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_log_stds"]
