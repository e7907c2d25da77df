"""What a federation has learned as a file of plain arrays: the form to give away, since reading it executes nothing."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from fed_envs.files import atomic_file
from sb3_fedguide.common.array_files import array_mismatches, read_arrays, write_arrays
from sb3_fedguide.common.normalization import FederatedNormalizer
from sb3_fedguide.common.stacked import to_arrays, to_tensors

FORMAT, VERSION = "sb3_fedguide parameters", 1
HEADER = "header"


class ParameterFiles(BaseAlgorithm):
    """Mixin for federations: their parameters as a file of plain arrays, beside SB3's archive."""

    policy: Any
    normalizer: FederatedNormalizer
    normalize: bool
    pretrained: bool
    client_ids: list[int]

    def save(self, path: str | Path | io.BufferedIOBase, *args: Any, **kwargs: Any) -> None:
        """SB3's zip archive, as in SB3. To load it is to unpickle it: give models away with :meth:`export_parameters`.

        A file appears complete or not at all.
        """
        if isinstance(path, io.BufferedIOBase):
            super().save(path, *args, **kwargs)
            return
        target = Path(path) if Path(path).suffix else Path(f"{path}.zip")
        target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(target, "wb") as file:
            super().save(file, *args, **kwargs)  # type: ignore[arg-type]

    def export_parameters(self, path: str | Path) -> None:
        """Write what was learned as plain arrays with a JSON header (npz, no pickle): every client's policy and
        normalisation, and the offline stage's priors, experts and values where there are any.

        What only further training needs is not in it: optimisers, random streams, and the server's state.
        """
        _write(self, path)

    def import_parameters(self, path: str | Path) -> None:
        """Take what :meth:`export_parameters` wrote, into a model made with the same settings; nothing is unpickled.

        :raises ValueError: for a file that is damaged or of another federation, with what differs; this model stays as it is
        """
        _read(self, path)

    def parameter_parts(self) -> list[str]:
        """What an exported file of this model holds beside policies and normalisation."""
        return []

    def begin_parts(self, parts: Sequence[str], pretrained: bool) -> None:
        """Set up the parts that a file holds, before :meth:`set_parameter_arrays`.

        :param pretrained: whether the file's model had been through the offline stage
        :raises ValueError: for parts that this model does not have
        """
        if parts:
            raise ValueError(f"the file holds {', '.join(sorted(parts))}, which this method has not")

    def parameter_arrays(self) -> dict[str, np.ndarray]:
        """Copies of everything learned, by name."""
        policy = to_arrays(self.policy.state_dict(), "policy/")
        statistics = to_arrays(self.normalizer.state_dict(), "normalizer/")
        del statistics["normalizer/returns"]  # of unfinished episodes
        return {**policy, **statistics}

    def set_parameter_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Take arrays named as in :meth:`parameter_arrays`, which fit."""
        self.policy.load_state_dict(to_tensors(take_prefix(arrays, "policy/")))
        self.normalizer.load_state_dict(to_tensors(take_prefix(arrays, "normalizer/")), strict=False)


def _write(model: ParameterFiles, path: str | Path) -> None:
    """Write ``model``'s parameters as one npz file: a JSON header and arrays.

    :raises OSError: where it cannot be written; nothing half-written stays
    """
    header = {
        "format": FORMAT, "version": VERSION, "algorithm": type(model).__name__, "pretrained": model.pretrained,
        "parts": model.parameter_parts(), **_identity(model),
    }  # fmt: skip
    write_arrays(Path(path), {HEADER: np.array(json.dumps(header, allow_nan=False)), **model.parameter_arrays()})


def _read(model: ParameterFiles, path: str | Path) -> None:
    """Take what :func:`_write` wrote; a file that does not fit leaves the model as it is.

    :raises ValueError: for a file that is absent, damaged, pickled, of another version, or of another federation; the
        message says what differs
    """
    try:
        arrays = read_arrays(Path(path))
    except FileNotFoundError:
        raise ValueError(f"there is no parameter file {path}") from None
    header = _read_header(arrays.pop(HEADER, None), path)
    differences = [
        f"{name} is {header.get(name)!r} in the file and {value!r} here"
        for name, value in _identity(model).items()
        if header.get(name) != value
    ]
    if not differences:
        blank = copy.copy(model)  # shallow: what is set on it leaves the model alone
        try:
            blank.begin_parts(header["parts"], header["pretrained"])
        except ValueError as error:
            raise ValueError(f"{path} does not fit this {type(model).__name__}: {error}") from None
        differences = array_mismatches(arrays, blank.parameter_arrays()) or _broken(arrays)
    if differences:
        raise ValueError(f"{path} does not fit this {type(model).__name__}: {'; '.join(differences)}")
    model.begin_parts(header["parts"], header["pretrained"])
    model.set_parameter_arrays(arrays)
    model.pretrained = header["pretrained"]


def take_prefix(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with ``prefix``, without it."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _identity(model: ParameterFiles) -> dict[str, Any]:
    """What decides, beside the arrays, which actions a policy takes."""
    policy = model.policy
    space: Any = model.action_space
    return {
        "policy": type(policy).__name__,
        "activation": policy.activation_fn.__name__,
        "clients": [int(client) for client in model.client_ids],
        "normalize": bool(model.normalize),
        "action_low": [str(bound) for bound in space.low.tolist()],  # text, since a bound may be infinite
        "action_high": [str(bound) for bound in space.high.tolist()],
    }


def _read_header(array: np.ndarray | None, path: str | Path) -> dict[str, Any]:
    try:
        header = json.loads(str(array)) if array is not None else None
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} holds no parameters of a federation: its header is missing or another one")
    if header.get("version") != VERSION:
        raise ValueError(f"{path} has version {header.get('version')!r} of the format; this program reads version {VERSION}")
    parts, pretrained = header.get("parts"), header.get("pretrained")
    if not isinstance(parts, list) or not all(isinstance(part, str) for part in parts) or not isinstance(pretrained, bool):
        raise ValueError(f"{path} is damaged: its header does not say which parts it holds")
    return header


def _broken(arrays: dict[str, np.ndarray]) -> list[str]:
    lines = [f"{name} has non-finite entries" for name, array in sorted(arrays.items()) if not np.isfinite(array).all()]
    spreads = ("normalizer/obs.var", "normalizer/ret.var", "normalizer/obs.count", "normalizer/ret.count")
    return lines or [f"{name} has negative entries" for name in spreads if (arrays[name] < 0).any()]
