"""A federation's learned parameters as a file of plain arrays: the format to share, since reading it executes no code."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule
from torch import nn

from fed_envs.files import atomic_file
from sb3_fedguide.common.export import SETTINGS, ClientPolicies, ClientPolicy, Normalization, client_settings
from sb3_fedguide.common.normalization import Normalize
from sb3_fedguide.common.resumable import Resumable
from sb3_fedguide.common.spaces import describe_space, space_from
from sb3_fedguide.state.array_files import array_mismatches, read_arrays, take_prefix, write_arrays
from sb3_fedguide.state.held import Held, file_arrays, held_by
from sb3_fedguide.state.stacked import client_state, to_arrays, to_tensors

FORMAT, VERSION = "sb3_fedguide parameters", 1
HEADER = "header"


class ParameterFiles(ClientPolicies, Resumable):
    """Mixin for federations: their parameters as a file of plain arrays, beside SB3's archive."""

    normalize: Normalize
    pretrained: bool

    def save(self, path: str | Path | io.BufferedIOBase, *args: Any, **kwargs: Any) -> None:
        """SB3's zip archive, as in SB3. Loading it unpickles it: share models with :meth:`export_parameters`.

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
        """Write the learned parameters as plain arrays with a JSON header (npz, no pickle): every client's policy and
        normalisation, and the offline stage's priors, experts and values, if there are any.

        It omits the state that only further training needs: optimisers, random streams, and the server's state.
        """
        _write(self, path)

    def import_parameters(self, path: str | Path) -> None:
        """Read a file of :meth:`export_parameters` into a model with the same settings; nothing is unpickled.

        :raises ValueError: for a file that is damaged or of another federation, with the differences; this model is unchanged
        """
        _read(self, path)

    def acting_arrays(self) -> dict[str, np.ndarray]:
        """Copies of the arrays that determine all clients' actions and that the exchange may change: the policies under their
        parameters' names, and shared observation statistics under ``normalizer/``."""
        statistics = to_arrays(self.normalizer.state_dict(), "normalizer/") if self.normalizer.shared else {}
        shared = {name: array for name, array in statistics.items() if name.startswith("normalizer/obs.")}
        return {**to_arrays(self.policy.state_dict()), **shared}

    def set_acting_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Take some or all of the arrays, named as in :meth:`acting_arrays`; they must fit."""
        policy = {name: array for name, array in arrays.items() if not name.startswith("normalizer/")}
        self.policy.load_state_dict({**self.policy.state_dict(), **to_tensors(policy)})
        self.normalizer.load_state_dict(to_tensors(take_prefix(arrays, "normalizer/")), strict=False)

    def parameter_arrays(self, parts: Collection[str] | None = None) -> dict[str, np.ndarray]:
        """Copies of everything learned, by name.

        :param parts: parts to copy, complete or not; all complete ones if ``None``
        """
        policy = to_arrays(self.policy.state_dict(), "policy/")
        statistics = to_arrays(self.normalizer.state_dict(), "normalizer/")
        of_one_round = ("normalizer/returns", "normalizer/round_obs.")
        kept = {name: array for name, array in statistics.items() if not name.startswith(of_one_round)}
        chosen = _complete_parts(self) if parts is None else parts
        held = [file_arrays(self, held) for held in _exported(self) if held.part in chosen]
        return {**policy, **kept, **{name: array.copy() for arrays in held for name, array in arrays.items()}}


def _exported(model: ParameterFiles) -> list[Held]:
    """State in this model's files beside policies and normalisation, after the offline stage."""
    return [held for held in held_by(model).values() if held.part and model.holds(held.name)]


def _complete_parts(model: ParameterFiles) -> list[str]:
    """The parts that are complete now."""
    exported = _exported(model) if model.pretrained else []
    waiting = {
        held.part
        for held in exported
        if held.later and any(np.isnan(array).any() for array in file_arrays(model, held).values())
    }
    return list(dict.fromkeys(held.part for held in exported if held.part not in waiting))


def _part_differences(model: ParameterFiles, header: dict[str, Any]) -> list[str]:
    """Differences between the parts of a file and those of this model with its settings."""
    own = {held.part: held.later for held in _exported(model)} if header["pretrained"] else {}
    unknown = sorted(set(header["parts"]) - own.keys())
    missing = sorted(part for part, later in own.items() if not later and part not in header["parts"])
    lines = [f"the file holds {', '.join(unknown)}, which this method does not have with its settings"] if unknown else []
    return [*lines, f"the file holds no {', '.join(missing)}, which this model with its settings needs"] if missing else lines


def _write(model: ParameterFiles, path: str | Path) -> None:
    """Write ``model``'s parameters as one npz file: a JSON header and arrays.

    :raises OSError: if it cannot be written; no half-written file stays
    """
    header = {
        "format": FORMAT, "version": VERSION, "algorithm": type(model).__name__, "pretrained": model.pretrained,
        "parts": _complete_parts(model), **_identity(model), **_outside(model),
    }  # fmt: skip
    write_arrays(Path(path), {HEADER: np.array(json.dumps(header, allow_nan=False)), **model.parameter_arrays()})


def _read(model: ParameterFiles, path: str | Path) -> None:
    """Read a file of :func:`_write`; a file that does not fit does not change the model.

    :raises ValueError: for a file that is absent, damaged, pickled, of another version, or of another federation; the
        message names the differences
    """
    header, arrays = _open(path)
    differences = [
        f"{name} is {header.get(name)!r} in the file and {value!r} here"
        for name, value in _identity(model).items()
        if header.get(name) != value
    ]
    differences = differences or _part_differences(model, header)
    differences = differences or array_mismatches(arrays, model.parameter_arrays(header["parts"])) or _broken(arrays)
    if differences:
        raise ValueError(
            f"{path} does not fit this {type(model).__name__}: {'; '.join(differences)}; for its policies alone, without a "
            "federation, there is 'fedguide export'"
        )
    here = [held for held in _exported(model) if held.file and held.part in header["parts"]]
    if model.pretrained:  # otherwise everything is new
        model.begin_anew(held.name for held in _exported(model) if held not in here)
    for held in here:
        for name, array in file_arrays(model, held).items():
            array[...] = arrays[name]
    model.policy.load_state_dict(to_tensors(take_prefix(arrays, "policy/")))
    model.normalizer.load_state_dict(to_tensors(take_prefix(arrays, "normalizer/")), strict=False)
    model.pretrained = header["pretrained"]


def read_policies(path: str | Path, replaced: dict[str, np.ndarray] | None = None) -> dict[int, ClientPolicy]:
    """The policies in a file of :meth:`ParameterFiles.export_parameters`, by client; no federation is made.

    :param replaced: arrays of :meth:`ParameterFiles.acting_arrays` to put in place of the file's
    :raises ValueError: for a file that is absent, damaged or of another version
    """
    header, arrays = _open(path)
    put = {name if name.startswith("normalizer/") else f"policy/{name}": array for name, array in (replaced or {}).items()}
    mismatches = array_mismatches({**arrays, **put}, arrays)
    arrays = {**arrays, **put}
    if mismatches or (broken := _broken(arrays)):
        raise ValueError(f"{path} and the policies to put in place of its own: {(mismatches or broken)[0]}")
    policies = take_prefix(arrays, "policy/")
    if "spaces" not in header:
        raise ValueError(
            f"{path} is of an earlier version, without spaces; load it into a model of the same settings with "
            "import_parameters(), and export_parameters() again"
        )
    try:
        observations, actions = (space_from(header["spaces"][kind]) for kind in ("observation", "action"))
        settings = {name: value for name, value in header["settings"].items() if name in SETTINGS[header["learner"]]}
        moments = [arrays[f"normalizer/obs.{name}"] for name in ("mean", "var")]
        found = {
            int(client): ClientPolicy(
                header["learner"],
                observations,
                actions,
                getattr(nn, header["activation"]),
                client_state(to_tensors(policies), index),
                Normalization.of(*(moment[index] for moment in moments)) if header["normalize"] else None,
                settings,
            )
            for index, client in enumerate(header["clients"])
        }
        next(iter(found.values())).to_sb3()  # the others have the same shapes
    except (KeyError, IndexError, StopIteration, TypeError, AttributeError, ValueError, RuntimeError, AssertionError) as error:
        raise ValueError(f"{path} is damaged: its header does not belong to its arrays ({error})") from None
    return found


def _identity(model: ParameterFiles) -> dict[str, Any]:
    """Settings that, beside the arrays, determine a policy's actions."""
    policy, space = model.policy, model.action_space
    actions: dict[str, Any] = {"action_space": describe_space(space)}
    if isinstance(space, spaces.Box):  # bounds are text, since one may be infinite
        actions = {f"action_{name}": [str(bound) for bound in getattr(space, name).tolist()] for name in ("low", "high")}
    return {
        "policy": type(policy).__name__,
        "activation": policy.activation_fn.__name__,
        "clients": [int(client) for client in model.client_ids],
        "normalize": bool(model.normalize),
        **actions,
    }


def _outside(model: ParameterFiles) -> dict[str, Any]:
    """Settings that a policy needs beside the arrays without a federation, see :func:`read_policies`."""
    settings = {name: _plain(value) for name, value in client_settings(model).items()}
    return {
        "learner": model.learner,
        "spaces": {
            "observation": describe_space(model.client_observation_space),
            "action": describe_space(model.action_space),
        },
        "settings": {name: value for name, value in settings.items() if _is_plain(value)},
    }


def _plain(value: Any) -> Any:
    """A JSON number, also for a constant schedule; other values unchanged."""
    if isinstance(value, FloatSchedule) and isinstance(value.value_schedule, ConstantSchedule):
        value = value.value_schedule.val
    return value.item() if isinstance(value, np.generic) else value


def _is_plain(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and math.isfinite(value))


def _open(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays.

    :raises ValueError: for a file that is absent, damaged, pickled or of another version
    """
    try:
        arrays = read_arrays(Path(path))
    except FileNotFoundError:
        raise ValueError(f"there is no parameter file {path}") from None
    return _read_header(arrays.pop(HEADER, None), path), arrays


def _read_header(array: np.ndarray | None, path: str | Path) -> dict[str, Any]:
    try:
        header = json.loads(str(array)) if array is not None else None
    except (ValueError, RecursionError):
        header = None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} holds no parameters of a federation: its header is missing or different")
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
