"""The client's side of parameter averaging, for learners of any kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from sb3_fedguide.common.anchors import Parameters, snapshot
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.common.screening import Screening, check_screening
from sb3_fedguide.common.upload_privacy import UploadPrivacy
from sb3_fedguide.server.averaging import averaged_prefixes, averaging_is_due, policy_is_due
from sb3_fedguide.server.strategy import N_SAMPLES, Payload
from sb3_fedguide.settings.arguments import AveragingArguments
from sb3_fedguide.settings.signatures import adds
from sb3_fedguide.state.held import Held


class ParameterAveraging(Federation):
    """Mixin, listed before its learner, for methods that average policy parameters; optimiser state stays with its client.

    :param average: ``"all"``, only the ``"actor"`` (with ``log_std``), or only the ``"critic"``
    :param average_every: rounds between two averages
    :param average_until: last round after which to average; ``None`` for no end
    :param aggregator: ``"mean"``, or the coordinate-wise ``"median"`` or ``"trimmed_mean"``, which a minority of
        wrong uploads cannot move far; both ignore numbers of samples
    :param trim_fraction: share of the clients that ``"trimmed_mean"`` leaves out at either end
    :param server_step: factor of the clients' mean update at the server: a number (1: the average itself), or ``"exp"``
        for FedExP's, see :func:`~sb3_fedguide.server.averaging.fedexp_step`
    :param server_momentum: share of the server's last update that is added to the next one
    :param mix: share of the broadcast in a client's new parameters: a number, or a schedule of the remaining progress,
        bounded to [0, 1]. In a configuration ``lin_1`` falls from 1 to 0 over the run, and ``until_0.4`` is 1 for two fifths
        of the run and 0 after it, so that every client ends with its own policy
    :param screening: share of its environment steps that a client may spend on tests of the broadcast against its own
        policy, see :class:`~sb3_fedguide.common.screening.Screening`; with 0 it takes the broadcast untested
    :param noise_multiplier: standard deviation of the Gaussian noise that each client adds to every number that it uploads, in
        units of ``clipping_norm``; 0 for none
    :param clipping_norm: L2 norm to which each client clips its update before it uploads it, see
        :class:`~sb3_fedguide.common.upload_privacy.UploadPrivacy`; ``None`` for no clipping
    :param delta: the delta of the logged epsilon; it changes nothing else
    :raises ValueError: for values out of range

    All other parameters are those of the learner, :class:`FederatedPPO` or :class:`FederatedDDPG`.
    """

    state_attributes: ClassVar[tuple[str | Held, ...]] = ("screening_state", "privacy_state", "known_parameters")

    @adds(AveragingArguments)
    def __init__(self, given: AveragingArguments, *args: Any, **learner: Any) -> None:
        check_screening(given.screening, given.average)
        self.average = given.average
        self.average_every = given.average_every
        self.average_until = given.average_until
        self.aggregator = given.aggregator
        self.trim_fraction = given.trim_fraction
        self.server_step = given.server_step
        self.server_momentum = given.server_momentum
        self.mix = given.mix
        self.screening = given.screening
        #: see :meth:`Screening.begin`; empty without tests
        self.screening_state: dict[str, np.ndarray] = {}
        self._tests = Screening(self)
        self.noise_multiplier = given.noise_multiplier
        self.clipping_norm = given.clipping_norm
        self.delta = given.delta
        #: see :meth:`UploadPrivacy.begin`; empty without clipping and noise
        self.privacy_state: dict[str, np.ndarray] = {}
        #: the part of each client's upload that the server knows already, ``(n_clients, ...)`` each; empty without clipping
        self.known_parameters: Parameters = {}
        self._privacy = UploadPrivacy(self)
        self._shares: dict[int, float] = {}
        super().__init__(*args, **learner)

    def _setup_model(self) -> None:
        super()._setup_model()  # type: ignore[safe-super]
        self._privacy.begin()

    def _setup_state(self) -> None:
        super()._setup_state()
        self._tests.begin()

    def _identity(self) -> dict[str, Any]:
        privacy = {"noise_multiplier": self.noise_multiplier or None, "clipping_norm": self.clipping_norm}
        return {**super()._identity(), **privacy}  # the privacy accountant counts in these

    def public_parameters(self) -> Parameters:
        """The publicly known part of each client's upload before the first exchange: the initial policies, which depend
        only on the federation's seed. Called before they change; ``(n_clients, ...)`` each."""
        return snapshot(self.policy, self.averaged_prefixes)

    @property
    def averaged_prefixes(self) -> tuple[str, ...]:
        """Prefixes of the names of averaged parameters."""
        return averaged_prefixes(self.average, self.policy.actor_prefixes, self.policy.critic_prefixes)

    def sends_policy(self, round: int) -> bool:
        return policy_is_due(round, self.average, self.average_every, self.average_until) and self.mix_now() > 0

    def upload(self, index: int) -> Payload:
        payload = super().upload(index)
        if not averaging_is_due(self.round, self.average_every, self.average_until):
            return payload
        if self._tests.is_alone(index) or self.mix_now() == 0:  # its policy must not move the others
            return {**payload, N_SAMPLES: np.array(0, dtype=np.float32)}
        return {**payload, **self._policy_upload(index)}

    @property
    def protects_uploads(self) -> bool:
        return self._privacy.has_noise

    def upload_metrics(self, public: bool = False) -> dict[str, float]:
        return self._privacy.metrics(public) if self._privacy.is_on else {}

    def upload_summary(self) -> dict[str, Any]:
        return self._privacy.summary() if self._privacy.is_on else {}

    def draw_secret_keys(self) -> None:
        if self.protects_uploads:
            self._privacy.draw_secret_keys()

    def outgoing(self, index: int) -> Payload:
        payload = super().outgoing(index)
        return self._privacy.protect(index, payload) if self._privacy.is_on else payload

    def upload_shapes(self) -> dict[str, list[int]]:
        policy = {name: list(array.shape) for name, array in self._policy_upload(0).items()}
        return {**super().upload_shapes(), **policy}

    def _policy_upload(self, index: int) -> Payload:
        """Copies of a client's averaged parameters under SB3's names, and their number of samples."""
        payload = self.averaged_parameters(index)
        payload[N_SAMPLES] = np.array(self.rollout_size, dtype=np.float32)
        return payload

    def averaged_parameters(self, index: int) -> Payload:
        """Copies of the averaged parameters of the client at position ``index``, under SB3's names."""
        named = self.policy.named_parameters()
        return {
            name: parameter[index].detach().cpu().numpy().copy()
            for name, parameter in named
            if name.startswith(self.averaged_prefixes)
        }

    def mix_now(self) -> float:
        """The share that clients take now, in [0, 1]."""
        return min(1.0, max(0.0, self.mix(self._current_progress_remaining))) if callable(self.mix) else self.mix

    def test_work(self) -> np.ndarray | None:
        if not self.screening:
            return None
        untimed = self.screening_state["untimed"]
        work = untimed / self.rollout_size
        untimed[:] = 0
        return work

    def take_broadcasts(self, broadcasts: Mapping[int, Payload]) -> None:
        mix = self.mix_now()
        # a newcomer, or a client that is alone, takes the whole broadcast or nothing
        self._shares = {
            index: 1.0 if self._tests.is_alone(index) or not self.has_trained[index] else mix for index in broadcasts
        }
        if self._privacy.is_on:
            self._privacy.receive(broadcasts)
        super().take_broadcasts(broadcasts)

    def _accepted(self, broadcasts: Mapping[int, Payload]) -> Mapping[int, Payload]:
        """The broadcasts that pass the clients' tests."""
        if not self.screening:
            return broadcasts
        averages = {index: self._of_policy(broadcast) for index, broadcast in broadcasts.items()}
        refused = self._tests.refused({index: self.mixed(index, average) for index, average in averages.items() if average})
        return {
            index: {name: array for name, array in broadcast.items() if index not in refused or name not in averages[index]}
            for index, broadcast in broadcasts.items()
        }

    def receive(self, index: int, broadcast: Payload) -> None:
        super().receive(index, broadcast)
        self.policy.load_client(index, self.mixed(index, self._of_policy(broadcast)))

    def _of_policy(self, broadcast: Payload) -> Payload:
        return {name: array for name, array in broadcast.items() if name.startswith(self.averaged_prefixes)}

    def mixed(self, index: int, average: Payload) -> Payload:
        """The parameters of the client at position ``index`` after it takes its share of ``average``."""
        share = self._shares.get(index, 1.0)
        if share == 1 or not average:
            return average
        own = self.averaged_parameters(index)
        return {name: ((1 - share) * own[name] + share * array).astype(np.float32) for name, array in average.items()}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_tests", "_shares", "_privacy"]
