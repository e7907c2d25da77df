"""Common parts of `fedguide push` and `fedguide pull`: the shared files of a run, their size limits, and checks."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.run_folder import DEPLOYED, EVALUATIONS, PARAMETERS
from sb3_fedguide.settings.config import MAX_BYTES

if TYPE_CHECKING:
    from huggingface_hub import HfApi

    from fed_envs import Family
    from sb3_fedguide.settings.config import Config

CARD, CURVE = "README.md", "curve.png"
#: Files that every run's folder must have.
NEEDED = ("config.yml", "metadata.json", "summary.json", PARAMETERS)
#: Shared files, and their size limits in bytes; no other file is sent or taken, and none of them is pickled.
FILES = {
    PARAMETERS: 256_000_000,
    DEPLOYED: 256_000_000,
    "config.yml": MAX_BYTES,
    "metadata.json": 10_000_000,
    "metadata.sha256": 100,
    "summary.json": 20_000_000,
    EVALUATIONS: 50_000_000,
    "versions.json": 100_000,
    CARD: 1_000_000,
    CURVE: 5_000_000,
}
LOGIN = "log in with 'hf auth login', or set HF_TOKEN (https://huggingface.co/settings/tokens)"
#: Largest number of environments of a pulled run, all clients together.
MAX_ENVIRONMENTS = 4096
#: Numbers in networks that a run's settings may ask for beyond those in its arrays, such as values of the offline stage that
#: its method does not have.
MAX_UNUSED = 50_000_000


class RefusedError(ValueError):
    """A run may be correct, but ``fedguide pull`` refuses to make its environments or networks."""


def hub_api() -> HfApi:
    """:raises ValueError: without the package ``huggingface_hub``"""
    if importlib.util.find_spec("huggingface_hub") is None:
        raise ValueError("the Hugging Face hub needs the package huggingface_hub: pip install 'sb3-fedguide[hub]'")
    from huggingface_hub import HfApi

    from sb3_fedguide import __version__

    return HfApi(library_name="sb3-fedguide", library_version=__version__)


def check_repository(name: str) -> None:
    """:raises ValueError: for a name that is not ``OWNER/NAME``"""
    part = r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}"
    if not re.fullmatch(f"{part}/{part}", name) or ".." in name or name.endswith((".git", ".", "-")):
        raise ValueError(f"{name!r} is not a repository of the hub: give OWNER/NAME, of letters, digits and . _ -")


@contextmanager
def hub_errors(api: HfApi, repository: str, revision: str | None = None) -> Iterator[None]:
    """Turn errors of the hub into one line with a remedy.

    :raises ValueError: for all of them
    """
    from httpx2 import HTTPError
    from huggingface_hub import errors

    try:
        yield
    except errors.GatedRepoError:
        raise ValueError(f"{repository} needs its owner's permission: ask for it on {api.endpoint}, then {LOGIN}") from None
    except errors.RepositoryNotFoundError:
        raise ValueError(
            f"there is no repository {repository} on {api.endpoint}, or it is private and you have no access: {LOGIN}"
        ) from None
    except errors.RevisionNotFoundError:
        raise ValueError(f"{repository} has no revision {revision}; give one of its branches, tags or commits") from None
    except errors.HfHubHTTPError as error:
        status = error.response.status_code
        reason = error.server_message or error.response.reason_phrase
        remedy = f"; {LOGIN}, with a token that may write there" if status in (401, 403) else ""
        raise ValueError(f"{api.endpoint} refuses this for {repository} ({status}): {reason}{remedy}") from None
    except errors.OfflineModeIsEnabled:
        raise ValueError("HF_HUB_OFFLINE is set, so the hub is not contacted; unset it") from None
    except HTTPError as error:
        raise ValueError(f"{api.endpoint} cannot be reached ({error or type(error).__name__}); is there a network?") from None
    except RuntimeError as error:  # a failed upload, with the reason in its cause
        raise ValueError(f"{api.endpoint}: {error} ({error.__cause__ or type(error).__name__})") from None


@contextmanager
def hub_answers(api: HfApi) -> Iterator[None]:
    """Wrap only requests and the parsing of their answers: another service may answer.

    :raises ValueError: for an answer that the hub would not give
    """
    try:
        yield
    except (KeyError, TypeError, AttributeError, json.JSONDecodeError) as error:
        raise ValueError(f"{api.endpoint} does not answer as the hub does ({error!r}); check HF_ENDPOINT") from None


def check_run(folder: Path, packages: Sequence[str]) -> tuple[dict[str, Any], Config, Family]:
    """Make the federation of a run's folder, as evaluations do, to check that its files are valid and fit together.

    :param packages: modules that register its algorithm or world
    :return: its ``summary.json``, hyperparameters and family
    :raises RefusedError: for settings that need more than its arrays have, or that may name files
    :raises ValueError: for a folder of something else
    """
    from sb3_fedguide.cli.saved_run import load_model, read_deployed_policies, read_run
    from sb3_fedguide.settings.packages import import_packages

    import_packages(packages)
    run, config, family = read_run(folder)
    _check_claims(folder, config, family)
    read_deployed_policies(folder, load_model(folder, config, family))
    return run, config, family


def _check_claims(folder: Path, config: Config, family: Family) -> None:
    """Check settings before their use: a few bytes of settings can ask for more memory than any machine has.

    :raises RefusedError: if they do, or if Gymnasium's environments may read files
    """
    values = config.values
    n_envs = family.n_clients * values["n_envs_per_client"]
    if n_envs > MAX_ENVIRONMENTS:
        raise RefusedError(
            f"{folder} asks for {n_envs} environments; at most {MAX_ENVIRONMENTS} are made from downloaded settings"
        )
    layers = values["policy_kwargs"]["net_arch"] or []
    networks = list(layers.values()) if isinstance(layers, dict) else [layers, layers]
    networks += [[values["pretraining"][name]] * 2 for name in ("dice_width", "prior_width")]
    claimed = family.n_clients * sum(sum(widths) + sum(a * b for a, b in pairwise(widths)) for widths in networks)
    held = (folder / PARAMETERS).stat().st_size // 4
    if claimed > held + MAX_UNUSED:
        raise RefusedError(f"{folder} asks for networks of {claimed} numbers, but its {PARAMETERS} has no more than {held}")
    for client in family.clients:
        for text in _texts(getattr(client, "kwargs", {})):
            if re.search(r"[/\\:]", text):
                raise RefusedError(
                    f"client {client.client} of {folder} has the keyword argument {text!r}, which may name a file or a "
                    "module; register your own environment that sets it itself (--gym-packages)"
                )


def _texts(value: Any) -> Iterator[str]:
    """All texts in plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for part in value.items():
            yield from _texts(part)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)
