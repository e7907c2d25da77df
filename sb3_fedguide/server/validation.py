"""Checks of the clients' uploads before aggregation: form, finiteness, and norms compared with the other clients'."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

from sb3_fedguide.server.payload import N_SAMPLES, OBSERVATION_COUNT, OBSERVATION_VAR, OBSERVATIONS, Payload
from sb3_fedguide.settings.arguments import UPLOAD_BOUND as UPLOAD_BOUND

#: An upload's arrays as names with shapes, in the order of names.
Form = tuple[tuple[str, tuple[int, ...]], ...]

#: Name of the group of all arrays without one of the prefixes.
PARAMETERS = "parameters"

#: With fewer uploads there is no majority that could identify an outlier.
FEWEST_NORMS = 3


def check_uploads(
    uploads: Mapping[int, Payload], sent: Mapping[int, Payload], groups: tuple[str, ...] = (), bound: float = UPLOAD_BOUND
) -> dict[int, str]:
    """The uploads of an exchange that are rejected, and why.

    In this order an upload has to

    * be named arrays of float32 (moments of observations: float64), with a positive number of samples if it has one;
    * be finite;
    * have the names and shapes that most of the finite uploads have; with zero samples, some of them and no parameters;
    * have norms of at most ``median + bound * max(MAD, median / 2)`` of the positive norms of the remaining uploads, if there
      are three or more. MAD is their median absolute deviation. It is never above the median, so that ``bound`` allows between
      ``1 + bound / 2`` and ``1 + bound`` times the median.

    The norm of parameters is that of their difference from the last broadcast to the client, or, before the first broadcast,
    from the uploads' median. Other groups have the norm of the arrays themselves: a head should differ.

    An upload with only a wrong direction passes: a norm does not detect it.

    :param uploads: payload by client id
    :param sent: the last broadcast to each client
    :param groups: names that begin with the same one of these have a norm of their own; all others are parameters, and have
        one together
    :param bound: see above
    :return: the reason by client for every rejected upload
    """
    reasons = {client: reason for client in sorted(uploads) if (reason := broken(uploads[client], groups))}
    forms = {client: form(uploads[client]) for client in sorted(uploads) if client not in reasons}
    if not forms:
        return reasons
    idle = {client for client in forms if is_idle(uploads[client])}
    usual = Counter(own for client, own in forms.items() if client not in idle or idle == forms.keys()).most_common(1)[0][0]
    for client, own in forms.items():
        if own != usual and not (client in idle and set(own) <= set(usual)):
            reasons[client] = _difference(own, usual)
    left = [client for client in forms if client not in reasons]
    if len(left) >= FEWEST_NORMS:
        apart, shapes = (*groups, N_SAMPLES), dict(usual)
        known = {
            client: {name: array for name, array in sent.get(client, {}).items() if shapes.get(name) == np.shape(array)}
            for client in left
        }
        new = [name for name, _ in usual if not name.startswith(apart) and any(name not in own for own in known.values())]
        holders = [client for client in left if client not in idle]
        medians = {name: np.median(np.stack([uploads[client][name] for client in holders]), axis=0) for name in new if holders}
        norms = {client: group_norms(uploads[client], {**medians, **known[client]}, apart) for client in left}
        reasons |= _outliers(norms, bound)
    return reasons


def group_norms(upload: Payload, reference: Payload, groups: tuple[str, ...]) -> dict[str, float]:
    """Norm of each group of an upload's arrays, and of its parameters minus the reference."""
    squares: dict[str, float] = {}
    for name, array in upload.items():
        values = np.asarray(array, dtype=np.float64)
        group = next((prefix for prefix in groups if name.startswith(prefix)), PARAMETERS)
        if group == PARAMETERS:
            values = values - reference[name]
        squares[group] = squares.get(group, 0.0) + float(np.sum(values**2))
    return {group: math.sqrt(square) for group, square in squares.items()}


def _outliers(norms: Mapping[int, Mapping[str, float]], bound: float) -> dict[int, str]:
    reasons: dict[int, str] = {}
    for group in dict.fromkeys(group for own in norms.values() for group in own):
        limit = norm_limit([own[group] for own in norms.values() if group in own], bound)
        for client, own in norms.items():
            if own.get(group, 0.0) > limit:
                label = group.rstrip(".")
                reasons.setdefault(client, f"the norm of its {label} is {own[group]:.3g}, over the limit of {limit:.3g}")
    return reasons


def norm_limit(norms: list[float], bound: float) -> float:
    """``median + bound * max(MAD, median / 2)`` of the positive norms; infinite where none is positive."""
    # Clients that have not learned yet change nothing, and must not make outliers of those that have.
    positive = np.array([norm for norm in norms if norm > 0])
    if not len(positive):
        return math.inf
    median = float(np.median(positive))
    return median + bound * max(float(np.median(np.abs(positive - median))), median / 2)


def is_idle(upload: Payload) -> bool:
    """Whether an upload has zero samples, so that its client has no weight in averages."""
    return N_SAMPLES in upload and not np.any(upload[N_SAMPLES])


def broken(upload: Payload, groups: tuple[str, ...] = ()) -> str | None:
    """What is wrong with an upload by itself, if anything."""
    if not isinstance(upload, Mapping):
        return f"it is a {type(upload).__name__}, not named arrays"
    for name, array in upload.items():
        if not isinstance(name, str):
            return f"the name {name!r} is not a string"
        if not isinstance(array, np.ndarray | np.generic):
            return f"{name} is a {type(array).__name__}, not an array"
        kind = np.float64 if name.startswith(OBSERVATIONS) else np.float32
        if array.dtype != kind:
            return f"{name} has the type {array.dtype}, not {kind.__name__}"
        if not np.isfinite(array).all():
            return f"{name} has values that are not finite"
        if name in (OBSERVATION_COUNT, OBSERVATION_VAR) and (array < 0).any():
            return f"{name} is negative"
    if N_SAMPLES in upload:
        may_be_idle = all(name.startswith((N_SAMPLES, *groups)) for name in upload)
        if np.ndim(upload[N_SAMPLES]) or not (upload[N_SAMPLES] > 0 or (may_be_idle and upload[N_SAMPLES] == 0)):
            return f"{N_SAMPLES} is not a positive number"
    return None


def form(upload: Payload) -> Form:
    """Names and shapes of an upload."""
    return tuple(sorted((name, np.shape(array)) for name, array in upload.items()))


def _difference(own: Form, usual: Form) -> str:
    mine, theirs = dict(own), dict(usual)
    for name in theirs:
        if name not in mine:
            return f"{name} is missing"
        if mine[name] != theirs[name]:
            return f"{name} has the shape {mine[name]}, those of the others {theirs[name]}"
    return f"{next(name for name in mine if name not in theirs)} is not expected"
