"""Payloads between a client and the server."""

from __future__ import annotations

import numpy as np

#: A payload in one direction between a client and the server: named arrays, float32 except counts and moments.
Payload = dict[str, np.ndarray]

#: Key of an upload's number of samples, the weight of its client in averages.
N_SAMPLES = "n_samples"

#: Log key of the epsilon of the client with the most uploads: over clients its largest value counts, not the average.
EPSILON = "privacy/epsilon"

#: Moments of a client's observations, float64: uploads have the last round's, broadcasts those of all clients since the start.
OBSERVATIONS = "observations."
OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR = (f"{OBSERVATIONS}{name}" for name in ("count", "mean", "var"))

#: Prefixes of the names of a policy's parameters, as in SB3: PPO's actor (with ``log_std``) and critic, and DDPG's.
PPO_ACTOR = ("mlp_extractor.policy_net.", "action_net.", "log_std")
PPO_CRITIC = ("mlp_extractor.value_net.", "value_net.")
DDPG_ACTOR = ("actor.",)
DDPG_CRITIC = ("critic.",)
