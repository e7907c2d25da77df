"""The one resolver of hyperparameters: a file of ``zoo_configs``, then ``-params``, then flags, all checked."""

from __future__ import annotations

import copy
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import yaml

from sb3_fedguide.registry import ALGORITHMS, algorithm, registered_names
from sb3_fedguide.settings import networks, schema
from sb3_fedguide.settings.arguments import Rounds
from sb3_fedguide.settings.names import check_names, nearest
from sb3_fedguide.settings.networks import NetworkConfig
from sb3_fedguide.settings.participants import n_participants

if TYPE_CHECKING:
    from fed_envs import Family
    from sb3_fedguide.common.federated_ddpg import FederatedDDPG
    from sb3_fedguide.common.federated_ppo import FederatedPPO

#: Name of a configuration to its folder inside ``zoo_configs``.
CONFIGURATIONS = {"tuned": ".", "paper": "paper", "quick": "."}
#: Configuration to the file of ``zoo_configs`` whose entries override every method's own.
OVERLAYS = {"quick": "quick.yml"}

#: Families whose settings a user's own family on the same backbone takes.
BACKBONE_FAMILIES = {
    "Bandit2D": "Bandit2D", "Reacher-v5": "Reacher", "Hopper-v5": "Hopper", "Walker2d-v5": "Walker2D",
    "HalfCheetah-v5": "HalfCheetah", "MetaWorld-v3": "MetaWorld10", "PointMaze-v3": "PointMaze",
}  # fmt: skip

DEFAULT = "default"
#: Limits far above any configuration's needs: bytes of a file, and the extent of its expanded aliases.
MAX_BYTES, MAX_NODES, MAX_DEPTH = 1_000_000, 20_000, 20
NESTED = ("pretraining", "policy_kwargs")
_SET_ELSEWHERE = {"gamma": "the DICE value takes the algorithm's own gamma"}


class _Loader(yaml.SafeLoader):
    """YAML 1.2's numbers: ``3e-4`` is one, as in JSON; duplicate keys are refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode) and key.value != "<<"]
        for name in names:
            if names.count(name) > 1:
                raise yaml.YAMLError(f"the key {name!r} is given twice in one mapping, line {node.start_mark.line + 1}")
        return super().construct_mapping(node, deep)

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        super().flatten_mapping(node)
        if len(node.value) > MAX_NODES:
            raise yaml.YAMLError("its merged mappings hold too much for a configuration")


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


@dataclass(frozen=True)
class Config:
    """Hyperparameters of one run, complete and checked.

    :param algo: command-line name of the algorithm
    :param entry: the entry of the configuration file that applied beyond ``default``
    :param values: every hyperparameter as plain data, ``n_rounds`` included
    """

    algo: str
    entry: str
    values: dict[str, Any]

    @property
    def n_rounds(self) -> int:
        return self.values["n_rounds"]

    def make(self, env: Any, **arguments: Any) -> FederatedPPO | FederatedDDPG:
        """Construct the algorithm.

        :param env: as for the algorithm's constructor
        :param arguments: constructor arguments that are not hyperparameters, such as ``seed``
        :raises ValueError: if the values do not fit together
        """
        values = {name: schema.schedule_or_value(value) for name, value in self.values.items() if name != "n_rounds"}
        network = network_config(self.algo).model_validate(values.pop("policy_kwargs"))
        policy = values.pop("policy")
        with warnings.catch_warnings():
            # SB3 compares a client's batch_size with the steps of all clients; FederatedPPO has checked it against its own.
            warnings.filterwarnings("ignore", "You have specified a mini-batch size", UserWarning)
            try:
                return algorithm(self.algo)(policy, env, policy_kwargs=network.to_kwargs(), **values, **arguments)
            except (MemoryError, RuntimeError) as error:
                if isinstance(error, RuntimeError) and "allocate" not in str(error):
                    raise
                raise ValueError(f"there is not enough memory for a model with these settings: {error}") from None


def resolve(
    algo: str,
    family: Family,
    conf_file: str = "tuned",
    entry: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    n_timesteps: int | None = None,
) -> Config:
    """The hyperparameters of a run.

    :param algo: command-line name of an algorithm
    :param family: clients to train
    :param conf_file: ``"tuned"``, ``"paper"``, ``"quick"`` (tuned, but small and short), or the path of a YAML file
    :param entry: name of the family whose settings to take; by default the family's own, or that of its backbone
    :param overrides: from ``-params`` and flags; nested ones by dotted keys
    :param n_timesteps: steps of all clients together instead of ``n_rounds``
    :raises ValueError: for anything unknown, of the wrong type or out of range
    """
    check_names([algo], ALGORITHMS, "algorithm")
    names = (entry or family.name, BACKBONE_FAMILIES.get(family.backbone, ""))
    path, applied, merged = layers(algo, conf_file, names, overrides or {})
    try:
        values = complete(merged, algo)
    except ValueError as error:
        raise ValueError(f"{error} ({_origin(path, applied)})") from None
    if n_timesteps is not None:
        if n_timesteps < 1:
            raise ValueError(f"n_timesteps={n_timesteps} must be at least 1; it counts the steps of all clients together")
        values["n_rounds"] = rounds_of(values, family.n_clients, n_timesteps)
    return Config(algo, applied, values)


def layers(
    algo: str, conf_file: str, names: Sequence[str], overrides: Mapping[str, Any], check: bool = True
) -> tuple[Path, str, dict[str, Any]]:
    """Values of a configuration, its overlay and ``overrides`` together; not yet checked.

    :param names: of entries; the first one in the configuration applies
    :param overrides: nested ones by dotted keys
    :param check: refuse unknown hyperparameters in files, and name the file
    :return: the file, the entry that applied beyond ``default``, and the values
    """
    path = config_path(conf_file, algo)
    applied, merged = _entries(path, names, algo, check)
    if conf_file in OVERLAYS:
        merged = _merge(merged, _entries(_config_folder() / OVERLAYS[conf_file], names, algo, check)[1])
    return path, applied, _merge(merged, _nest(overrides))


def _entries(path: Path, names: Sequence[str], algo: str, check: bool) -> tuple[str, dict[str, Any]]:
    """The first of the entries ``names`` in a file, and its values over the file's ``default``."""
    content = read_config(path)
    applied = next((name for name in names if name in content), DEFAULT)
    merged: dict[str, Any] = {}
    for name in dict.fromkeys((DEFAULT, applied)):
        if name in content:
            if check:
                _check_keys(content[name], algo, f"{path}, entry {name!r}")
            merged = _merge(merged, content[name])
    return applied, merged


def rounds_of(values: Mapping[str, Any], n_clients: int, n_timesteps: int) -> int:
    """Rounds of ``n_timesteps`` steps of all clients together."""
    return -(-n_timesteps // (values["rollout_size"] * n_participants(values["client_fraction"], n_clients)))


def complete(given: Mapping[str, Any], algo: str) -> dict[str, Any]:
    """Check plain values and fill in the defaults of the constructors.

    :raises ValueError: for the first value that is wrong
    """
    from sb3_fedguide.settings.pretraining import PretrainingConfig

    parameters = schema.hyperparameters_of(algo)
    _check_keys(given, algo, "the hyperparameters")
    if "n_rounds" not in given:
        raise ValueError("the number of rounds is missing; give n_rounds in the configuration, or --rounds")
    values: dict[str, Any] = {
        "policy": schema.check_value("policy", given.get("policy", "MlpPolicy"), _policy_type(algo)),
        "n_rounds": schema.check_value("n_rounds", given["n_rounds"], Rounds),
    }
    for name, (hint, default) in parameters.items():
        if name not in NESTED:
            values[name] = schema.check_value(name, given[name], hint) if name in given else default
    network = schema.check_model("policy_kwargs", network_config(algo), given.get("policy_kwargs") or {}, {})
    offline = schema.check_model("pretraining", PretrainingConfig, given.get("pretraining") or {}, _SET_ELSEWHERE)
    values["policy_kwargs"] = network.model_dump(mode="json")
    values["pretraining"] = offline.model_dump(mode="json", exclude=set(_SET_ELSEWHERE))
    return values


def config_path(conf_file: str, algo: str) -> Path:
    """The YAML file of a configuration, by name or path.

    :raises ValueError: if there is none
    """
    own = ALGORITHMS[algo].settings
    if own is not None and CONFIGURATIONS.get(conf_file) == ".":
        return own
    if conf_file in CONFIGURATIONS:
        folder = _config_folder() / CONFIGURATIONS[conf_file]
        path = folder / f"{algo}.yml"
        return path if path.is_file() else _inherited_path(folder, algo)
    path = Path(conf_file)
    if not path.is_file():
        hint = "" if path.suffix else nearest(conf_file, CONFIGURATIONS)
        raise ValueError(f"no configuration {conf_file!r}.{hint} Give {', '.join(CONFIGURATIONS)}, or the path of a YAML file")
    return path


def _config_folder() -> Path:
    import zoo_configs

    return Path(next(iter(zoo_configs.__path__)))


def _inherited_path(folder: Path, algo: str) -> Path:
    """A user's own algorithm has no file here; it takes the settings of the nearest class with a file."""
    cls = algorithm(algo)
    for name in (*registered_names(cls), cls.base_settings):
        if name is not None and (path := folder / f"{name}.yml").is_file():
            return path
    raise ValueError(f"there are no settings for {algo}; give a YAML file with -conf, or settings in register_algorithm()")


def read_config(path: Path) -> dict[str, dict[str, Any]]:
    """A configuration file: a mapping of families (and ``default``) to hyperparameters.

    :raises ValueError: if it cannot be read or is not a configuration
    """
    content = read_yaml(path)
    if not isinstance(content, dict) or not all(isinstance(entry, dict) for entry in content.values()):
        raise ValueError(
            f"{path}: a configuration maps families (or {DEFAULT!r}) to their hyperparameters, "
            "e.g. 'HopperHard: {n_rounds: 100}'"
        )
    return content


def read_yaml(path: Path) -> Any:
    """A YAML file as plain data.

    :raises ValueError: if it cannot be read, is not YAML, or is too large for a configuration
    """
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot read the configuration {path}: {error.strerror}") from None
    if len(text) > MAX_BYTES:
        raise ValueError(f"{path} is not a configuration: it has more than {MAX_BYTES} bytes")
    return _parse_yaml(text, str(path))


def _parse_yaml(text: str | bytes, source: str) -> Any:
    try:
        value = yaml.load(text, _Loader)  # a SafeLoader
        _check_extent(value)
    except RecursionError:
        raise ValueError(f"{source} is not valid YAML: it is nested too deeply") from None
    except Exception as error:  # int(), float() and datetime inside the loader raise various errors
        raise ValueError(f"{source} is not valid YAML: {' '.join(str(error).split()) or type(error).__name__}") from None
    return value


def _check_extent(value: Any) -> None:
    """Refuse aliases that expand to too much data.

    :raises yaml.YAMLError: for data that are too many or nested too deeply
    """
    seen, waiting = 0, [(value, 0)]
    while waiting:
        item, depth = waiting.pop()
        seen += 1
        if seen > MAX_NODES or depth > MAX_DEPTH:
            raise yaml.YAMLError("it holds too much, or is nested too deeply, for a configuration")
        if isinstance(item, dict):
            waiting += [(part, depth + 1) for pair in item.items() for part in pair]
        elif isinstance(item, list | tuple | set):
            waiting += [(part, depth + 1) for part in item]


def parse_params(pairs: Sequence[str], flag: str = "-params") -> dict[str, Any]:
    """``key:value`` pairs of ``-params`` or another flag; values are YAML scalars or lists, and no code is executed.

    :raises ValueError: for a pair without a key or value, a key that is given twice, or a value that is not YAML
    """
    values: dict[str, Any] = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key or not text:
            raise ValueError(f"{flag} takes key:value pairs such as learning_rate:3e-4, but got {pair!r}")
        if key in values:
            raise ValueError(f"{flag} gives {key!r} twice")
        try:
            values[key] = _parse_yaml(text, key)
        except ValueError:
            raise ValueError(f"{flag} {key}: {text!r} is not a number, text or [list]") from None
    return values


def _policy_type(algo: str) -> Any:
    return Literal[schema.policies(algo)]


def network_config(algo: str) -> type[NetworkConfig]:
    """The type of an algorithm's ``policy_kwargs``; a user's own class may have it as ``network_config``.

    :raises ValueError: if that is not a :class:`~sb3_fedguide.settings.networks.NetworkConfig`
    """
    if ALGORITHMS[algo].arguments is None and (own := getattr(algorithm(algo), "network_config", None)) is not None:
        if not isinstance(own, type) or not issubclass(own, NetworkConfig):
            raise ValueError(f"{algo}: network_config must be a subclass of settings.networks.NetworkConfig, not {own!r}")
        return own
    return getattr(networks, schema.declared_arguments(algo).network_config)


def _check_keys(values: Mapping[str, Any], algo: str, where: str) -> None:
    known = {"policy", "n_rounds", *schema.hyperparameters_of(algo)}
    for name in values:
        if not isinstance(name, str) or name not in known:
            raise ValueError(
                f"unknown hyperparameter {name!r} of {algo} in {where}.{nearest(name, known)} "
                f"Known: {', '.join(sorted(known))}"
            )


def _nest(dotted: Mapping[str, Any]) -> dict[str, Any]:
    """``{"a.b": 1}`` as ``{"a": {"b": 1}}``."""
    nested: dict[str, Any] = {}
    for key, value in dotted.items():
        head, dot, tail = key.partition(".")
        if dot and head not in NESTED:
            raise ValueError(f"{key!r}: only {' and '.join(NESTED)} have parts.{nearest(head, NESTED)}")
        nested = _merge(nested, {head: {tail: value}} if dot else {key: value})
    return nested


def _merge(base: Mapping[str, Any], update: Mapping[str, Any]) -> dict[str, Any]:
    """``update`` over ``base``; the nested mappings are merged key by key."""
    merged = copy.deepcopy(dict(base))
    for key, value in update.items():
        if key in NESTED and isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = {**merged[key], **value}
        else:
            merged[key] = copy.deepcopy(value)
    return merged


def _origin(path: Path, entry: str) -> str:
    return f"settings: {path.name}, {entry}, and the command line"
