"""Differential privacy of uploads: a client clips its update and adds noise before it uploads it."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_fedguide.common.privacy_accountant import check_accountant, epsilon
from sb3_fedguide.seeding import Role, seed_sequence
from sb3_fedguide.server.payload import EPSILON, N_SAMPLES, OBSERVATIONS, Payload

if TYPE_CHECKING:
    from sb3_fedguide.common.parameter_averaging import ParameterAveraging


class UploadPrivacy:
    """Each client's clipping and noise, and its spent privacy.

    ``known`` is the part of a client's upload that the server knows already, and ``d`` the difference of the upload to it, as
    one vector. The client uploads

    ``known + d * min(1, clipping_norm / |d|) + N(0, (noise_multiplier * clipping_norm)^2)``.

    The server knows its last broadcast to the client, and before that the initial policy from the federation's seed.
    The client adds the noise, so that neither the server nor a reader of the transport ever sees an update without it. The
    noise depends only on the update and the client's key (:func:`gaussian_noise`): a run resumed from a checkpoint uploads
    the same again, and no two updates ever get the same noise. In one process the key comes from the federation's seed; a
    client on its own machine draws a key that nobody else knows. A client that has left the average (``screening``) uploads a
    difference of zero, with noise: nobody sees that it has left.

    The idea is that of McMahan et al. (2018), with the noise at the client instead of the server.
    """

    def __init__(self, model: ParameterAveraging) -> None:
        self.model = model

    @property
    def is_on(self) -> bool:
        """Whether uploads are clipped or get noise."""
        return self.model.clipping_norm is not None

    @property
    def has_noise(self) -> bool:
        return self.model.noise_multiplier > 0

    def begin(self) -> None:
        """Check that clipping and noise cover the whole upload, and make ``privacy_state``, unless it was loaded.

        It holds for each client, ``(n_clients,)``: the number of uploads with clipping or noise (``uploads``), and of them
        those that were longer than ``clipping_norm`` (``clipped``); the round of the last one (``round``), and the norm of its
        update (``norm``); and the noise's ``key``, ``(n_clients, 8)``, uint32.

        :raises ValueError: for noise without a clipping norm or without the accountant, and if anything unprotected would
            leave the client
        """
        model = self.model
        if self.has_noise:
            self._check_noise()
        if not self.is_on:
            return
        public = model.public_parameters()
        if other := sorted(model.upload_shapes().keys() - public.keys() - {N_SAMPLES}):
            raise ValueError(
                f"clipping_norm and noise_multiplier protect uploads of parameters, and {type(model).__name__} uploads "
                f"{', '.join(other)} as well; use FedAvg, FedProx, FedKL, FedSVRPGM, FedRL or FedGuideR"
            )
        if model.privacy_state:
            return
        assert model.seed is not None
        n_clients = model.n_clients
        keys = [seed_sequence(model.seed, Role.UPLOAD_NOISE, client).generate_state(8) for client in model.client_ids]
        model.privacy_state.update(
            uploads=np.zeros(n_clients, dtype=int),
            clipped=np.zeros(n_clients, dtype=int),
            round=np.full(n_clients, -1),
            norm=np.zeros(n_clients),
            key=np.array(keys, dtype=np.uint32).reshape(n_clients, 8),
        )
        model.known_parameters = public

    def _check_noise(self) -> None:
        model = self.model
        if not self.is_on:
            raise ValueError(
                f"noise_multiplier={model.noise_multiplier} is in units of clipping_norm, and there is none: give one, "
                "such as the update norm that the log has without noise (privacy/update_norm)"
            )
        check_accountant()
        if model.normalize == "shared":
            raise ValueError(
                "noise_multiplier protects uploads of parameters, and normalize='shared' uploads exact observation "
                "statistics; use normalize=True, whose statistics stay with their client, or False"
            )

    def draw_secret_keys(self) -> None:
        """Replace the keys that come from the federation's seed by secret ones."""
        keys = self.model.privacy_state["key"]
        keys[:] = np.frombuffer(secrets.token_bytes(keys.nbytes), dtype=np.uint32).reshape(keys.shape)

    def receive(self, broadcasts: Mapping[int, Payload]) -> None:
        """Remember the broadcasts, which the server knows, by the client's position."""
        known = self.model.known_parameters
        for index, broadcast in broadcasts.items():
            for name in broadcast.keys() & known.keys():
                known[name][index] = broadcast[name]

    def protect(self, index: int, payload: Payload) -> Payload:
        """The upload of the client at position ``index`` instead of ``payload``.

        :raises ValueError: for an array without a part that the server knows already
        """
        model = self.model
        if self.has_noise and N_SAMPLES not in payload:  # nothing is averaged now
            return {}
        if N_SAMPLES not in payload or (not payload[N_SAMPLES] and not self.has_noise):
            return payload
        # without noise, shared observation statistics go beside the parameters; with it there are none
        apart = {name for name in payload if name == N_SAMPLES or (name.startswith(OBSERVATIONS) and not self.has_noise)}
        values = {name: array for name, array in payload.items() if name not in apart}
        known = {name: array[index] for name, array in model.known_parameters.items()}
        if unprotected := sorted(values.keys() - known.keys()):
            raise ValueError(f"noise_multiplier and clipping_norm do not protect {', '.join(unprotected)}, which it uploads")
        n_samples = payload[N_SAMPLES]
        if not n_samples:
            if model.mix_now() == 0:  # as for all clients
                return {N_SAMPLES: n_samples}
            values, n_samples = known, np.array(model.rollout_size, dtype=np.float32)
        others = {name: payload[name] for name in apart}
        return {**others, **self._privatized(index, values, known), N_SAMPLES: n_samples}

    def _privatized(self, index: int, values: Payload, known: Payload) -> Payload:
        """The arrays ``values``, with clipping of their difference to ``known``, and with noise."""
        model, state = self.model, self.model.privacy_state
        assert model.clipping_norm is not None
        names = sorted(values)
        ours, theirs = (
            np.concatenate([np.ravel(arrays[name]) for name in names]).astype(np.float64) for arrays in (values, known)
        )
        norm = float(np.linalg.norm(ours - theirs))
        vector = ours + (clipping_factor(norm, model.clipping_norm) - 1.0) * (ours - theirs)
        if self.has_noise:
            key = state["key"][index].tobytes()
            content = int(state["uploads"][index]).to_bytes(8, "little") + ours.tobytes() + theirs.tobytes()
            noise = gaussian_noise(key, content, len(ours))
            vector += model.noise_multiplier * model.clipping_norm * noise
        state["uploads"][index] += 1
        state["clipped"][index] += norm > model.clipping_norm
        state["round"][index], state["norm"][index] = model.round, norm
        ends = np.cumsum([np.size(values[name]) for name in names])
        parts = zip(names, np.split(vector, ends[:-1]), strict=True)
        return {name: part.astype(np.float32).reshape(np.shape(values[name])) for name, part in parts}

    def metrics(self, public: bool) -> dict[str, float]:
        """Metrics of this round's uploads, by log key; empty if there were none.

        :param public: only metrics that reveal nothing about the updates
        """
        model, state = self.model, self.model.privacy_state
        norms = state["norm"][state["round"] == model.round]
        if not len(norms):
            return {}
        assert model.clipping_norm is not None
        metrics = {"privacy/noise_multiplier": float(model.noise_multiplier)}
        if self.has_noise:
            metrics[EPSILON] = epsilon(model.noise_multiplier, int(state["uploads"].max()), model.delta)
        if not public:
            metrics["privacy/update_norm"] = float(np.median(norms))
            metrics["privacy/clipped"] = float(np.mean(norms > model.clipping_norm))
        return metrics

    def summary(self) -> dict[str, Any]:
        """The privacy spent in the whole run, for its summary; epsilon is that of the client with the most uploads."""
        model, state = self.model, self.model.privacy_state
        uploads = state["uploads"]
        summary = {
            "noise_multiplier": model.noise_multiplier,
            "clipping_norm": model.clipping_norm,
            "uploads": {str(client): int(number) for client, number in zip(model.client_ids, uploads, strict=True)},
            "clipped": float(state["clipped"].sum() / max(uploads.sum(), 1)),
        }
        if not self.has_noise:
            return summary
        return {**summary, "epsilon": epsilon(model.noise_multiplier, int(uploads.max()), model.delta), "delta": model.delta}


def clipping_factor(norm: float, clipping_norm: float) -> float:
    """The factor of an update of L2 norm ``norm``; exactly one if it is not longer than ``clipping_norm``.

    For a norm of NaN it is NaN too, so that nothing of such an update is uploaded.
    """
    return 1.0 if norm <= clipping_norm else clipping_norm / norm


def gaussian_noise(key: bytes, content: bytes, size: int) -> np.ndarray:
    """``size`` standard normal numbers, float64, which look random to anybody without the key.

    SHAKE-256 of key and content, by the method of Box and Muller.

    :param key: of fixed length
    :param content: the update that gets the noise; different contents get independent numbers
    """
    n_pairs = -(-size // 2)
    bits = np.frombuffer(hashlib.shake_256(key + content).digest(16 * n_pairs), dtype="<u8")
    uniform = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53  # in (0, 1)
    radius, angle = np.sqrt(-2.0 * np.log(uniform[:n_pairs])), 2.0 * np.pi * uniform[n_pairs:]
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])[:size]
