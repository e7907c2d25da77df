"""The configuration files of a deployment's server and clients, checked before anything starts."""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import pydantic

from sb3_fedguide.deployment.config import ServerConfig
from sb3_fedguide.deployment.flower.certificates import CA, SERVER, SERVER_KEY, read_public_key
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.server.methods import COMMON, find_method, make_strategy
from sb3_fedguide.settings.arguments import FederationArguments
from sb3_fedguide.settings.config import CONFIGURATIONS, DEFAULT, complete, layers, read_yaml
from sb3_fedguide.settings.names import check_names


class _File(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", strict=True)


_Model = TypeVar("_Model", bound=_File)


class ServerFile(_File):
    """The server's configuration file.

    :param algo: command-line name of the method
    :param env: family whose settings to take, as for the clients; no environment is made here
    :param conf: settings, as for ``-conf``
    :param params: hyperparameters to overwrite, as for the clients; the server takes those that concern it
    :param n_rounds: communication rounds, by default those of the settings
    :param seed: of the federation
    :param clients: public key of each client by its number, or the file that holds it
    :param timeout: seconds that a client may take for a round
    :param setup_timeout: seconds that a client may take for each step of the offline stage
    :param start_clients: number of clients to wait for before anything begins; by default all
    :param min_clients: smallest number of replies with which a round ends
    :param wait: seconds to wait for missing clients before the server gives up; null: for ever
    :param listen: address and port on which clients reach the server
    :param certificates: folder of ``fedguide deploy certificates``
    :param folder: folder of the server's state
    """

    algo: str
    env: str = DEFAULT
    conf: str = "tuned"
    params: dict[str, Any] = {}
    n_rounds: int | None = None
    seed: int = pydantic.Field(ge=0, lt=2**31)
    clients: dict[int, str] = pydantic.Field(min_length=1)
    timeout: float | None = pydantic.Field(default=3600.0, gt=0)
    setup_timeout: float | None = pydantic.Field(default=6 * 3600.0, gt=0)
    start_clients: int | None = None
    min_clients: int = 1
    wait: float | None = pydantic.Field(default=None, ge=0)
    listen: str = "0.0.0.0:9443"
    certificates: str
    folder: str


class ClientFile(_File):
    """The part of a client's configuration file that is about the connection; the rest describes its site.

    :param server: ``host:port`` of the server
    :param ca: the federation's ``ca.crt``
    :param key: this client's private key
    :param folder: folder of the client's state
    """

    server: str
    ca: str
    key: str
    folder: str


class ServerDeployment:
    """A server's file, checked, with absolute paths.

    :raises ValueError: for anything that a user can put right
    """

    def __init__(self, path: Path) -> None:
        file = _checked(ServerFile, _mapping(path), path)
        base = path.absolute().parent
        self.listen = _address(file.listen, path, "listen")
        self.certificates, self.folder = base / file.certificates, base / file.folder
        for name in (CA, SERVER, SERVER_KEY):
            _check_file(self.certificates / name, "run 'fedguide deploy certificates' first")
        _check_private(self.certificates / SERVER_KEY)
        self.clients = {client: _key_text(text, base, path) for client, text in file.clients.items()}
        self.keys = {read_public_key(text): client for client, text in self.clients.items()}
        if sorted(self.clients) != list(range(len(self.clients))):
            raise ValueError(f"{path}: clients are numbered from 0 to {len(self.clients) - 1}, not {sorted(self.clients)}")
        if len(self.keys) < len(self.clients):
            raise ValueError(f"{path}: two clients have the same key; every client has a key of its own")
        limits = {name: getattr(file, name) for name in ("timeout", "setup_timeout", "start_clients", "min_clients", "wait")}
        try:
            settings = _settings(file, base)
            given = {name: settings[name] for name in (*COMMON, *find_method(file.algo).defaults) if name in settings}
            rollout_size = settings.get("rollout_size", FederationArguments.rollout_size)
            n_clients, n_rounds = len(self.clients), settings["n_rounds"]
            self.server = ServerConfig(file.algo, n_clients, n_rounds, rollout_size, file.seed, given, **limits)
            make_strategy(file.algo, given, n_clients, file.seed)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        except TypeError as error:
            raise ValueError(f"{path}: one of the settings has the wrong type: {error}") from None

    def process_settings(self) -> dict[str, Any]:
        """Settings for the process of the round loop."""
        return {"server": asdict(self.server), "clients": self.clients, "folder": str(self.folder)}


class ClientDeployment:
    """A client's file, checked except for its site, with absolute paths.

    :raises ValueError: for anything that a user can put right
    """

    def __init__(self, path: Path) -> None:
        given = _mapping(path)
        connection = {name: given.pop(name) for name in ClientFile.model_fields if name in given}
        file = _checked(ClientFile, connection, path)
        base = path.absolute().parent
        self.address = host, port = _address(file.server, path, "server")
        self.server = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        self.ca, self.key, self.folder = base / file.ca, base / file.key, base / file.folder
        _check_file(self.ca, "it comes from the server's machine")
        _check_file(self.key, "run 'fedguide deploy key' first")
        _check_private(self.key)
        for name in ("metadata", "cache_dir"):
            if isinstance(given.get(name), str):
                given[name] = str(base / given[name])
        if isinstance(given.get("conf"), str):
            given["conf"] = _conf(given["conf"], base)
        self.site = given

    def process_settings(self) -> dict[str, Any]:
        """Settings for the process that answers a message."""
        return {"site": self.site, "folder": str(self.folder)}


def _conf(conf: str, base: Path) -> str:
    """A configuration's name unchanged, or a path relative to the file that gives it."""
    return conf if conf in CONFIGURATIONS else str(base / conf)


def _settings(file: ServerFile, base: Path) -> dict[str, Any]:
    """The settings for the clients. They are checked, except if that would need an algorithm's class.

    :raises ValueError: for a wrong setting
    """
    check_names([file.algo], ALGORITHMS, "algorithm")
    own = ALGORITHMS[file.algo].arguments is None
    rounds = {} if file.n_rounds is None else {"n_rounds": file.n_rounds}
    merged = layers(file.algo, _conf(file.conf, base), (file.env,), {**file.params, **rounds}, check=not own)[2]
    if "n_rounds" not in merged:
        raise ValueError("the number of rounds is missing; give n_rounds")
    if not own:
        complete(merged, file.algo)
    return merged


def _mapping(path: Path) -> dict[str, Any]:
    content = read_yaml(path)
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise ValueError(f"{path}: a configuration maps names to values, e.g. 'algo: fedguide'; see docs/deployment.md")
    return content


def _checked(model: type[_Model], values: Mapping[str, Any], path: Path) -> _Model:
    try:
        check_names(values, model.model_fields, "name")
        return model.model_validate(dict(values))
    except pydantic.ValidationError as error:
        problem = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in problem["loc"])
        raise ValueError(f"{path}: {where}: {problem['msg'][0].lower()}{problem['msg'][1:]}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _address(text: str, path: Path, name: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    try:
        if ":" in host:
            ipaddress.IPv6Address(host)
        if not host or not 1 <= int(port) <= 65535:
            raise ValueError
    except ValueError:
        raise ValueError(f"{path}: {name}: {text!r} is not an address such as fed.example.org:9443") from None
    return host, int(port)


def _key_text(text: str, base: Path, path: Path) -> str:
    """A public key from the configuration, or from the file that it names."""
    if not text.startswith("ecdsa-"):
        _check_file(base / text, "give a client's public key, or the file that holds it")
        text = (base / text).read_text(encoding="utf-8", errors="replace")
    try:
        read_public_key(text)
    except ValueError as error:
        raise ValueError(f"{path}: clients: {error}") from None
    return text.strip()


def _check_file(path: Path, remedy: str) -> None:
    if not path.is_file():
        raise ValueError(f"there is no file {path}: {remedy}")


def _check_private(path: Path) -> None:
    if path.stat().st_mode & 0o077:
        raise ValueError(f"{path} is a private key that others can read: chmod 600 {path}")
