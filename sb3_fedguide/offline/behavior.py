"""Behaviour policies: medium-quality policies of the nominal backbones that generate the offline data.

A policy is a small tanh network whose Gaussian action ``u`` is executed as ``tanh(u)``. A policy that is clipped instead
puts atoms at +-1, which no density model of the actions can represent. The files hold plain arrays and are read without
pickle; :mod:`sb3_fedguide.offline.train_behavior` is the script that made them.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping
from pathlib import Path

import gymnasium
import numpy as np

from fed_envs.files import atomic_file
from sb3_fedguide.state.array_files import load_arrays

__all__ = ["BehaviorPolicy", "behavior_policy", "squash"]

POLICY_FOLDER = Path(__file__).parent / "behavior_policies"
FORMAT_VERSION = 1
# float32 tanh reaches exactly 1.0 near u = 9; an executed action stays strictly inside the box.
MAX_ACTION = np.float32(1.0 - 1e-6)


def squash(raw_actions: np.ndarray) -> np.ndarray:
    """``tanh(u)``, strictly inside (-1, 1) in float32."""
    return np.clip(np.tanh(np.asarray(raw_actions, dtype=np.float32)), -MAX_ACTION, MAX_ACTION)


class BehaviorPolicy:
    """A squashed Gaussian policy in NumPy: ``a = tanh(mean(s) + noise_scale * exp(log_std) * noise)``.

    :param arrays: ``weight_<l>`` of shape ``(out, in)`` and ``bias_<l>`` per layer (tanh between layers), ``log_std``
        of shape ``(action_dim,)``, ``obs_mean`` and ``obs_var`` of shape ``(obs_dim,)``, ``obs_clip`` and
        ``obs_epsilon`` (scalars), and optionally strings and scalars that describe the training
    :param noise_scale: multiplies the trained standard deviation; 0 gives the deterministic policy
    :raises ValueError: if arrays are missing, have shapes that do not fit together, or are not finite
    """

    def __init__(self, arrays: Mapping[str, np.ndarray], noise_scale: float = 1.0) -> None:
        self.arrays = {name: np.asarray(array) for name, array in arrays.items()}
        self.noise_scale = float(noise_scale)
        n_layers = max(1, sum(name.startswith("weight_") for name in self.arrays))
        required = {f"{kind}_{layer}" for kind in ("weight", "bias") for layer in range(n_layers)}
        required |= {"log_std", "obs_mean", "obs_var", "obs_clip", "obs_epsilon"}
        if missing := sorted(required - self.arrays.keys()):
            raise ValueError(f"a behaviour policy needs the arrays {sorted(required)}; missing: {missing}")
        numbers = {name: array for name, array in self.arrays.items() if array.dtype.kind in "fiu"}
        if broken := [name for name, array in numbers.items() if not np.isfinite(array).all()]:
            raise ValueError(f"the behaviour policy's arrays {broken} have non-finite entries")
        # Contiguous (in, out) weights: the product's rounding must not depend on how the file stored them.
        self._layers = [
            (
                np.ascontiguousarray(self.arrays[f"weight_{layer}"].T, dtype=np.float32),
                self.arrays[f"bias_{layer}"].astype(np.float32),
            )
            for layer in range(n_layers)
        ]
        self._std = np.exp(self.arrays["log_std"].astype(np.float32))
        self._obs_mean = self.arrays["obs_mean"].astype(np.float64)
        self._obs_scale = 1.0 / np.sqrt(self.arrays["obs_var"].astype(np.float64) + float(self.arrays["obs_epsilon"]))
        self._obs_clip = float(self.arrays["obs_clip"])
        widths = [self._obs_mean.shape[0], *(bias.shape[0] for _, bias in self._layers)]
        shapes = [weight.shape for weight, _ in self._layers]
        if shapes != list(itertools.pairwise(widths)) or self._std.shape != (widths[-1],):
            raise ValueError(f"the behaviour policy's layers do not fit together: {shapes} for {widths[0]} observations")

    @property
    def obs_dim(self) -> int:
        return int(self._obs_mean.shape[0])

    @property
    def action_dim(self) -> int:
        return int(self._std.shape[0])

    def mean(self, observations: np.ndarray) -> np.ndarray:
        """Mean of the raw (unsquashed) action, ``(batch, action_dim)`` for raw observations ``(batch, obs_dim)``."""
        normalised = (np.asarray(observations, dtype=np.float64) - self._obs_mean) * self._obs_scale
        x = np.clip(normalised, -self._obs_clip, self._obs_clip).astype(np.float32)
        for layer, (weight, bias) in enumerate(self._layers):
            x = x @ weight + bias
            if layer < len(self._layers) - 1:
                x = np.tanh(x)
        return x

    def __call__(self, observations: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Executed actions, float32, strictly inside (-1, 1).

        :param observations: raw observations ``(batch, obs_dim)`` or ``(obs_dim,)``
        :param rng: draws the exploration noise
        """
        observations = np.asarray(observations)
        mean = self.mean(np.atleast_2d(observations))
        noise = rng.standard_normal(mean.shape, dtype=np.float32)
        actions = squash(mean + np.float32(self.noise_scale) * self._std * noise)
        return actions if observations.ndim > 1 else actions[0]

    @property
    def content_hash(self) -> str:
        """SHA-256 of the arrays and the noise scale: part of the key of the data that the policy makes."""
        digest = hashlib.sha256(repr(self.noise_scale).encode())
        for name in sorted(self.arrays):
            array = np.ascontiguousarray(self.arrays[name])
            digest.update(f"{name}:{array.dtype.str}:{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def save(self, path: str | Path) -> None:
        """Write the policy as an ``npz`` file of plain arrays."""
        with atomic_file(path, "wb") as file:
            np.savez_compressed(file, **{**self.arrays, "format_version": np.int64(FORMAT_VERSION)})  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path, noise_scale: float = 1.0) -> BehaviorPolicy:
        """Read a policy file.

        :raises ValueError: if the file is absent, is not an npz of plain arrays (pickled payloads are refused) or has
            another format version
        """
        try:
            arrays = load_arrays(Path(path))
        except FileNotFoundError as error:
            raise ValueError(f"no behaviour policy file {path}") from error
        except ValueError as error:
            raise ValueError(f"{path} is not a behaviour policy (an npz file of plain arrays): {error}") from error
        version = arrays.pop("format_version", None)
        if version is None or not np.array_equal(version, FORMAT_VERSION):
            raise ValueError(f"{path} has behaviour policy format {version}; this version reads format {FORMAT_VERSION}")
        return cls(arrays, noise_scale)


def behavior_policy(backbone: str, noise_scale: float = 1.0) -> BehaviorPolicy:
    """The shipped behaviour policy of a backbone.

    :param backbone: a Gymnasium environment id such as ``"Hopper-v5"``
    :raises ValueError: if none is shipped for it
    """
    path = POLICY_FOLDER / f"{backbone.split('-')[0]}.npz"
    if not path.exists():
        shipped = sorted(file.stem for file in POLICY_FOLDER.glob("*.npz"))
        trained = ""
        if backbone in gymnasium.registry:
            trained = f", or train one with `python -m sb3_fedguide.offline.train_behavior --env {backbone} --target RETURN`"
        raise ValueError(
            f"no behaviour policy for {backbone!r} (shipped: {', '.join(shipped)}): give the world's class a "
            "scripted_policy (docs/extending.md), or a Minari dataset with --dataset ID_OR_PATH, in Python "
            f"pretraining={{'dataset': 'ID_OR_PATH'}}{trained}"
        )
    return BehaviorPolicy.load(path, noise_scale)
