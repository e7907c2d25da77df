"""The privacy spent by clients' noised uploads: Opacus' accountant, for uploads instead of gradients."""

from __future__ import annotations

import functools
import importlib.util
import math
import warnings

import numpy as np

#: Renyi orders at which the accountant looks, dense enough to be within a tenth of the exact epsilon.
ORDERS = (1 + np.geomspace(1e-4, 1e4, 800)).tolist()
#: Two clipped updates differ by at most twice their clipping norm.
SENSITIVITY = 2.0


def check_accountant() -> None:
    """:raises ValueError: if Opacus is not installed"""
    if importlib.util.find_spec("opacus") is None:
        raise ValueError("noise_multiplier needs Opacus, which computes epsilon: pip install 'sb3-fedguide[privacy]'")


@functools.lru_cache(maxsize=1000)
def epsilon(noise_multiplier: float, n_uploads: int, delta: float) -> float:
    """Epsilon of ``n_uploads`` uploads of one client, at ``delta``.

    With probability ``1 - delta``, the client's uploads are at most ``exp(epsilon)`` times as likely as with any other data
    of the client: local differential privacy of the whole client. Its uploads are Gaussian mechanisms of
    L2 sensitivity ``2 * clipping_norm``, composed in Renyi differential privacy. Client sampling gives no discount: the
    server knows who uploads.

    :param noise_multiplier: standard deviation of the noise in units of ``clipping_norm``
    :return: infinite without noise
    """
    if n_uploads == 0:
        return 0.0
    if noise_multiplier == 0:
        return math.inf
    from opacus.accountants import RDPAccountant

    accountant = RDPAccountant()
    accountant.history = [(noise_multiplier / SENSITIVITY, 1.0, n_uploads)]  # every client uploads with probability one
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Optimal order is the")  # epsilon is then far from any use
        return max(0.0, accountant.get_epsilon(delta, alphas=ORDERS))
