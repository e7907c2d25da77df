"""Warnings in the first round in which a client's training goes wrong: which client, why, and what to try."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.federated_ppo import FederatedPPO
from sb3_fedguide.common.federation import Federation

#: Importance weights have collapsed if their effective sample share is below this.
LEAST_SAMPLE_SHARE = 0.01
#: V_phi misleads below this: rounding alone makes a constant V_phi negative.
LEAST_EXPLAINED_VARIANCE = -0.05
#: Mean KL from the rollout's policy, in nats, over all minibatches of a round; healthy rounds were at 0.002 to 0.06.
LARGEST_KL = 0.2
#: A client whose largest mixture weight is above this has one expert.
ONE_EXPERT = 0.99


class HealthCheck(NamedTuple):
    """A check of each client.

    :param key: log key of the value, after ``client_<k>/``
    :param is_wrong: whether such a value is wrong; NaN is not
    :param reason: what it means
    :param remedy: what to try, given the model's settings
    """

    key: str
    is_wrong: Callable[[float], bool]
    reason: str
    remedy: Callable[[Federation], str]


def _dice_remedy(model: Federation) -> str:
    assert isinstance(model, FedGuide)
    remedies = [] if model.beta == "auto" else ['beta="auto", which gives V_phi no weight where it does not help']
    remedies += [] if model.calibrate else ["calibrate=True"]
    return ", ".join([*remedies, "more or better offline data", "or beta=1, which leaves V_phi out"])


def _kl_remedy(model: Federation) -> str:
    assert isinstance(model, FederatedPPO)
    trust = ", a larger lambda_trust" if isinstance(model, FedGuide) else ""
    return f"a smaller learning_rate, fewer n_epochs (now {model.n_epochs}){trust}, or normalize=True"


HEALTH_CHECKS = (
    HealthCheck(
        "effective_sample_share",
        lambda share: share < LEAST_SAMPLE_SHARE,
        "the importance weights have collapsed onto a few states, so that the prior term is noise",
        lambda model: 'prior_loss="sample", which needs no weights',
    ),
    HealthCheck(
        "explained_variance_dice",
        lambda explained: explained < LEAST_EXPLAINED_VARIANCE,
        "V_phi has a negative explained variance: as a baseline it is worse than a constant",
        _dice_remedy,
    ),
    HealthCheck(
        "approx_kl",
        lambda kl: kl > LARGEST_KL,
        "the KL from the policy that acted has exploded: the rollout says little about the policy it led to",
        _kl_remedy,
    ),
)


def routes_one_to_one(rows: np.ndarray) -> bool:
    """Whether mixture weights are nearly a permutation: every client has one expert, and none has another's.

    :param rows: ``(n_clients, n_experts)``, each summing to one
    """
    return (
        len(rows) > 1 and bool((rows.max(axis=1) > ONE_EXPERT).all()) and len(set(rows.argmax(axis=1).tolist())) == len(rows)
    )


class HealthCallback(RoundCallback):
    """Warns if a client's training goes wrong: once for each check and client.

    The values are those of the log, per client; training does not change. A resumed run warns again.
    """

    def __init__(self) -> None:
        super().__init__()
        self._warned: set[tuple[str, int]] = set()

    def _on_round_end(self) -> None:
        for problem in self._problems():
            warnings.warn(f"round {self.model.round}: {problem}", stacklevel=1)

    def _problems(self) -> Iterator[str]:
        model, logged = self.model, self.logger.name_to_value
        for check in HEALTH_CHECKS:
            values = {client: float(logged.get(f"client_{client}/{check.key}", np.nan)) for client in model.client_ids}
            ill = [k for k, value in values.items() if check.is_wrong(value) and (check.key, k) not in self._warned]
            if ill:
                self._warned |= {(check.key, client) for client in ill}
                clients = ", ".join(f"client {client} ({check.key} {values[client]:.3g})" for client in ill)
                yield f"{clients}: {check.reason}; try {check.remedy(model)}"
        if (
            isinstance(model, FedGuide)
            and (model.family is None or model.family.world != "bandit2d")  # whose priors are peaks far apart
            and ("plan", 0) not in self._warned
            and routes_one_to_one(model.mixture_rows[model.present])
        ):
            self._warned.add(("plan", 0))
            yield (
                "the transport plan is a permutation: every client keeps to an expert of its own, and nothing of priors is "
                f"shared; try a larger eta (now {model.eta:g}), or an n_experts below the number of clients"
            )
