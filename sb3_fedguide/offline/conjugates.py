"""Convex conjugates of the divergence generators of the DICE objective, in forms with finite gradients everywhere.

``f*(y) = sup_{w >= 0} (y w - f(w))``, and its derivative is the density ratio ``w(y)`` that attains the supremum.

============ ============================================= ===================================== ======================
name         f(w)                                          f*(y)                                 w(y)
============ ============================================= ===================================== ======================
``soft_chi`` w ln w - w + 1 (w < 1), (w - 1)^2 / 2 (else)  e^y - 1 (y < 0), y + y^2 / 2 (else)   e^y (y < 0), 1 + y
``kl``       w ln w - w + 1                                e^y - 1                               e^y
``chi2``     (w - 1)^2 / 2                                 y + y^2 / 2 (y > -1), -1/2 (else)     max(1 + y, 0)
============ ============================================= ===================================== ======================

``kl`` caps the ratio at ``e^KL_MAX``: its f* goes on as a straight line from there, which is the exact conjugate of f
restricted to ``w <= e^KL_MAX``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch as th

__all__ = ["CONJUGATES", "KL_MAX", "conjugate"]

KL_MAX = 5.0


def soft_chi(y: th.Tensor) -> th.Tensor:
    # Clamped inside the branch: the exponential that is not selected must not give inf * 0 in the gradient.
    return th.where(y < 0, th.expm1(y.clamp(max=0.0)), y + 0.5 * y * y)


def kl(y: th.Tensor) -> th.Tensor:
    inside = y.clamp(max=KL_MAX)
    return th.expm1(inside) + (y - inside) * th.exp(th.full((), KL_MAX, dtype=y.dtype, device=y.device))


def chi2(y: th.Tensor) -> th.Tensor:
    inside = y.clamp(min=-1.0)
    return inside + 0.5 * inside * inside


CONJUGATES: dict[str, Callable[[th.Tensor], th.Tensor]] = {"soft_chi": soft_chi, "kl": kl, "chi2": chi2}


def conjugate(name: str) -> Callable[[th.Tensor], th.Tensor]:
    """The function ``f*`` of a generator.

    :raises ValueError: for an unknown name
    """
    if name not in CONJUGATES:
        raise ValueError(f"unknown generator {name!r}; choose one of {', '.join(CONJUGATES)}")
    return CONJUGATES[name]
