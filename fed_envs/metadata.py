"""The clients of a family: the schema of the metadata files, their validation, and loading.

A metadata file is JSON::

    {"schema_version": 1, "family": "HopperHard", "world": "locomotion", "backbone": "Hopper-v5",
     "max_episode_steps": 1000, "description": "...", "clients": [{"client": 0, "mass_scale": 0.9158037, ...}, ...]}

A client's fields depend on the world, see :mod:`fed_envs.clients`.
Anything unknown, missing, non-finite or out of range is refused with a message that names the file, the client and the field.
On the command line: ``python -m fed_envs.metadata {generate,show,validate}``.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
from gymnasium.envs.registration import EnvSpec
from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny, ValidationError, field_validator, model_validator

from fed_envs.clients import BACKBONES, CLIENT_MODELS, Client
from fed_envs.files import atomic_file
from fed_envs.registration import FAMILIES, entry_point_of, environment_id

SCHEMA_VERSION: Literal[1] = 1


class Family(BaseModel):
    """A family of client environments that share their observation and action spaces (the content of one metadata file)."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    schema_version: Literal[1] = SCHEMA_VERSION
    name: Annotated[str, Field(alias="family", pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=100)]
    world: str
    backbone: str
    max_episode_steps: Annotated[int, Field(strict=True, ge=1, lt=2**31)]
    description: str = ""
    clients: tuple[SerializeAsAny[Client], ...]

    @field_validator("world")
    @classmethod
    def _known_world(cls, world: str) -> str:
        if world not in CLIENT_MODELS:
            raise ValueError(f"must be one of {', '.join(map(repr, CLIENT_MODELS))} (got {world!r})")
        return world

    @field_validator("clients", mode="before")
    @classmethod
    def _clients_of_the_world(cls, value: Any, info: Any) -> tuple[Client, ...]:
        if "world" not in info.data:
            raise ValueError("clients: not checked, since the world is not known")
        if not isinstance(value, (list, tuple)) or not value:
            raise ValueError("clients: must be a list of at least one client")
        model = CLIENT_MODELS[info.data["world"]]
        clients: list[Client] = []
        problems: list[str] = []
        for position, entry in enumerate(value):
            content = entry.model_dump() if isinstance(entry, Client) else entry
            named = content.get("client", "?") if isinstance(content, dict) else "?"
            try:
                clients.append(model.model_validate(content))
            except ValidationError as error:
                problems += [f"client {named} (entry {position}): {line}" for line in describe(error)]
        ids = [client.client for client in clients]
        if not problems and ids != list(range(len(ids))):
            problems.append(f"client ids must be 0, 1, ..., {len(ids) - 1} in this order, each once; they are {ids}")
        if problems:
            raise ValueError("\n".join(problems))
        return tuple(clients)

    @model_validator(mode="after")
    def _backbone_of_the_world(self) -> Family:
        if self.backbone not in BACKBONES[self.world]:
            raise ValueError(
                f"backbone: a {self.world} world is built on {' or '.join(BACKBONES[self.world])}, not {self.backbone!r}"
            )
        if self.world == "bandit2d" and self.max_episode_steps != 1:
            raise ValueError("max_episode_steps: Bandit2D has one-step episodes, so this must be 1")
        return self

    @property
    def n_clients(self) -> int:
        return len(self.clients)

    def to_dict(self) -> dict[str, Any]:
        """The JSON-able content; optional client fields at their defaults are left out, so that new ones change no hash."""
        content = self.model_dump(mode="json", by_alias=True, exclude={"clients"})
        content["clients"] = [client.model_dump(mode="json", exclude_defaults=True) for client in self.clients]
        return content

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of everything that defines the environments (all but the description), as hexadecimal digits."""
        content = {key: value for key, value in self.to_dict().items() if key != "description"}
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return hashlib.sha256(canonical.encode("utf-8")).hexdigest()

    def client(self, client: int) -> Client:
        """Client ``client``'s parameters.

        :raises ValueError: if the family has no such client
        """
        if isinstance(client, bool) or not 0 <= int(client) < self.n_clients or int(client) != client:
            raise ValueError(f"{self.name} has clients 0 to {self.n_clients - 1}, not {client!r}")
        return self.clients[int(client)]

    def with_parameters(self, **parameters: Any) -> Family:
        """The same family with some client fields set to one value for all clients, e.g. ``off_peak_weight=0.1``.

        :raises ValueError: if a field does not exist or a value is out of range
        """
        if not parameters:
            return self
        content = self.to_dict()
        content["clients"] = [{**client, **parameters} for client in content["clients"]]
        return parse_family(content, f"{self.name} with {parameters}")

    def spec(self, client: int = 0, **kwargs: Any) -> EnvSpec:
        """The Gymnasium spec of one client's environment: it can be pickled or written as JSON, and needs no metadata file."""
        self.client(client)
        shipped = self.name in FAMILIES and load_family(self.name).content_hash == self.content_hash
        identity = {"family": self.name} if shipped else {"metadata": self.to_dict()}
        return EnvSpec(
            id=environment_id(self.name),
            entry_point=entry_point_of(self.world),
            max_episode_steps=self.max_episode_steps,
            kwargs={**identity, "client": int(client), **kwargs},
        )

    def make(self, client: int = 0, **kwargs: Any) -> gymnasium.Env:
        """One client's environment, wrapped as ``gymnasium.make`` does (time limit included).

        :param client: the client's id
        :param kwargs: passed to ``gymnasium.make``, e.g. ``render_mode="rgb_array"``
        """
        return gymnasium.make(self.spec(client), **kwargs)

    def dump(self, path: str | os.PathLike[str]) -> None:
        """Write the metadata file; it appears complete or not at all."""
        with atomic_file(path) as file:
            file.write(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")


def describe(error: ValidationError) -> list[str]:
    """One readable line per problem: ``field: what is wrong (got value)``."""
    lines = []
    for problem in error.errors(include_url=False):
        field = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "missing":
            message = "is missing"
        elif problem["type"] == "extra_forbidden":
            message = "is not a known field"
        elif problem["type"] != "value_error":
            message += f" (got {problem['input']!r})"
        lines += [
            f"{field}: {line}" if field and (field != "clients" or problem["type"] == "missing") else line
            for line in message.splitlines()
        ]
    return lines


def parse_family(content: Any, source: str) -> Family:
    """Validate the content of a metadata file.

    :param content: the decoded JSON
    :param source: its name in error messages, usually the file's path
    :raises ValueError: with one line per problem, naming the source, the client and the field
    """
    if not isinstance(content, dict):
        raise ValueError(f"{source}: a metadata file is a JSON object, this is a {type(content).__name__}")
    if type(content.get("schema_version")) is not int or content["schema_version"] != SCHEMA_VERSION:
        raise ValueError(
            f"{source}: schema_version: this version of fed_envs reads {SCHEMA_VERSION}, "
            f"the file has {content.get('schema_version', 'none')}"
        )
    try:
        return Family.model_validate(content)
    except ValidationError as error:
        raise ValueError("\n".join(f"{source}: {line}" for line in describe(error))) from None


def _refuse_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise ValueError(f"the key {key!r} is given twice in one object")
    return dict(pairs)


def read_family(path: str | os.PathLike[str]) -> Family:
    """Load and validate a metadata file.

    :raises ValueError: if the file cannot be read, is not JSON, or does not follow the schema
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read the metadata file {path}: {getattr(error, 'strerror', None) or error}") from None
    try:
        content = json.loads(text, object_pairs_hook=_refuse_duplicate_keys)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    return parse_family(content, str(path))


def load_family(family: str | os.PathLike[str] | Family, **parameters: Any) -> Family:
    """A family by name, by path of a metadata file, or as it is.

    :param family: a name in :data:`fed_envs.FAMILIES`, a path, or a :class:`Family`
    :param parameters: client fields to set for all clients, see :meth:`Family.with_parameters`
    :raises ValueError: for an unknown name (with the nearest one), or a file that does not follow the schema
    """
    if isinstance(family, Family):
        return family.with_parameters(**parameters)
    name = os.fspath(family)
    if name in FAMILIES:
        return _shipped_family(name).with_parameters(**parameters)
    if name.endswith(".json") or os.sep in name or Path(name).is_file():
        return read_family(name).with_parameters(**parameters)
    near = difflib.get_close_matches(name.lower(), {known.lower(): known for known in FAMILIES}, n=1)
    hint = f"did you mean {next(known for known in FAMILIES if known.lower() == near[0])!r}? " if near else ""
    raise ValueError(f"unknown family {name!r}: {hint}known are {', '.join(FAMILIES)}, or the path of a metadata .json file")


_SHIPPED: dict[str, Family] = {}


def _shipped_family(name: str) -> Family:
    if name not in _SHIPPED:
        _SHIPPED[name] = read_family(FAMILIES[name])
    return _SHIPPED[name]


if __name__ == "__main__":
    from fed_envs.metadata_command import main

    raise SystemExit(main())
