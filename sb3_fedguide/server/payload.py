"""What crosses between a client and the server."""

from __future__ import annotations

import numpy as np

#: What crosses between a client and the server in one direction: named arrays, float32 but for counts.
Payload = dict[str, np.ndarray]

#: Key of an upload's number of samples, the weight of its client in averages.
N_SAMPLES = "n_samples"
