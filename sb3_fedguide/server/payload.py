"""What crosses between a client and the server."""

from __future__ import annotations

import numpy as np

#: What crosses between a client and the server in one direction: named arrays, float32 but for counts and moments.
Payload = dict[str, np.ndarray]

#: Key of an upload's number of samples, the weight of its client in averages.
N_SAMPLES = "n_samples"

#: Log key of what the client has spent that uploaded most: over clients its largest value counts, and not the average.
EPSILON = "privacy/epsilon"

#: Moments of a client's observations, float64: those of its last round up, those of all clients since the beginning down.
OBSERVATIONS = "observations."
OBSERVATION_COUNT, OBSERVATION_MEAN, OBSERVATION_VAR = (f"{OBSERVATIONS}{name}" for name in ("count", "mean", "var"))

#: How the names of a policy's parameters begin, SB3's: PPO's actor (with ``log_std``) and critic, and DDPG's.
PPO_ACTOR = ("mlp_extractor.policy_net.", "action_net.", "log_std")
PPO_CRITIC = ("mlp_extractor.value_net.", "value_net.")
DDPG_ACTOR = ("actor.",)
DDPG_CRITIC = ("critic.",)
