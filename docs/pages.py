"""What the site's pages take from the package: families from their metadata, parameters from docstrings, places of results.

Run as a script it writes the families' pages to ``families``, as ``conf.py`` does before every build.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from pathlib import Path

from fed_envs import FAMILIES, Family, load_family
from fed_envs.registration import environment_id
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.settings.config import resolve
from sb3_fedguide.settings.ranges import range_of
from sb3_fedguide.settings.signatures import parameters

DOCS = Path(__file__).parent
ROOT = DOCS.parent
RESULTS = DOCS / "results.md"

#: Pages that the repository has at its root, where code hosts look for them, in capitals.
ROOT_PAGES = ("changelog", "contributing", "security")

#: Where environments.md explains the fields of a world's clients.
WORLDS = {
    "bandit2d": "bandit2d",
    "reacher": "reacher",
    "locomotion": "hopper-walker2d-halfcheetah",
    "metaworld": "metaworld10",
    "point_maze": "pointmaze",
}

#: A comment in a page, which a code host does not show, and what the site shows in its place.
PLACEHOLDER = re.compile(r"<!-- (?P<kind>parameters|results) of (?P<name>\S+) -->")

PARAMETER = re.compile(r":param (?P<name>\w+): (?P<text>.*)")


def unbroken(text: str) -> str:
    """Table rows whose figures keep their deviation and unit, and whose methods keep their name, on one line."""

    def row(match: re.Match[str]) -> str:
        line = re.sub(r"(?<=\d) (?=± |[kMG]?B\b|%)|(?<=±) (?=\d)", "\N{NO-BREAK SPACE}", match[0])
        return re.sub(r"^\| (fed\w+)-", "| \\1\N{NON-BREAKING HYPHEN}", line)

    return re.sub(r"^\| .*$", row, text, flags=re.MULTILINE)


def fill_placeholders(text: str, up: str) -> str:
    """A page with its placeholders replaced.

    :param up: from the page's folder to ``docs``, ``""`` or ``"../"``
    :raises ValueError: for a name that is no algorithm
    """

    def replacement(match: re.Match[str]) -> str:
        if match["name"] not in ALGORITHMS:
            raise ValueError(f"{match[0]}: there is no such algorithm; known are {', '.join(ALGORITHMS)}")
        return parameter_tables(match["name"]) if match["kind"] == "parameters" else result_links(match["name"], up)

    return PLACEHOLDER.sub(replacement, text)


def root_page(name: str) -> str:
    """A page of the repository's root, with its links as they are from ``docs``."""

    def moved(match: re.Match[str]) -> str:
        target = match[1]
        if target.startswith("docs/"):
            return f"]({target.removeprefix('docs/')}"
        stem = target.partition(".md")[0].lower()
        return f"]({stem}.md" if stem in ROOT_PAGES else f"](../{target}"

    return re.sub(r"\]\((?!\w+:|#)([^)]+)", moved, (ROOT / f"{name.upper()}.md").read_text())


def parameter_tables(name: str) -> str:
    """The constructor parameters of an algorithm's base classes, a table for each class that states some."""
    cls = algorithm(name)
    known = set(_own_parameters(cls))
    parts = []
    for base in cls.__mro__[1:]:
        own = {key: text for key, text in _own_parameters(base).items() if key not in known}
        if own:
            rows = [f"| `{key}` | {_default(cls, key)} | {_range(cls, key)} | {text} |" for key, text in own.items()]
            head = ["| parameter | default | range | meaning |", "|---|---|---|---|"]
            parts += [f"Of `{base.__name__}`:\n", *head, *rows, ""]
            known |= own.keys()
        if base.__name__ in ("FederatedPPO", "FederatedDDPG"):
            break  # what follows is Stable-Baselines3's, and these constructors state all of it that there is
    return "\n".join(parts)


def _own_parameters(cls: type) -> dict[str, str]:
    """The parameters that a class's own docstring explains, as Markdown."""
    if "__init__" not in cls.__dict__ or cls.__doc__ is None:
        return {}
    blocks = re.split(r"\n\s*\n|\n(?=:)", inspect.cleandoc(cls.__doc__))
    entries = (PARAMETER.fullmatch(" ".join(block.split())) for block in blocks)
    return {entry["name"]: _markdown(entry["text"]) for entry in entries if entry}


def _default(cls: type, key: str) -> str:
    """The default that ``cls`` really has: a subclass may hand another one on."""
    default = parameters(cls)[key].default
    return "" if default is inspect.Parameter.empty else f"`{default!r}`"


def _range(cls: type, key: str) -> str:
    limits = range_of(parameters(cls)[key].annotation)
    return "" if limits is None else f"{limits}"


def _markdown(text: str) -> str:
    """A docstring's reStructuredText: roles and literals become code."""
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", text)
    return text.replace("``", "`").replace("|", r"\|")


def result_links(name: str, up: str) -> str:
    """Links to the sections of the results that have a row of this algorithm."""
    found = [section for section, body in sections(RESULTS).items() if re.search(rf"^\| {re.escape(name)} \|", body, re.M)]
    return _links(found, up) or "None of its tables has a row of it yet."


def family_links(family: str, up: str) -> str:
    """Links to the sections of the results whose heading names this family."""
    return _links([section for section in sections(RESULTS) if family in re.findall(r"\w+", section)], up)


def _links(headings: list[str], up: str) -> str:
    return "\n".join(f"* [{heading}]({up}results.md#{slug(heading)})" for heading in headings)


def sections(page: Path) -> dict[str, str]:
    """Headings of the second level and what stands below each."""
    parts = re.split(r"^## (.+)$", page.read_text(), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def slug(heading: str) -> str:
    """A heading's anchor, as code hosts and the site make it."""
    return re.sub(r"[^\w\- ]", "", heading.replace("`", "").strip().lower()).replace(" ", "-")


def family_pages() -> dict[str, str]:
    """File name to content of every page in ``families``."""
    families = {name: load_family(name) for name in FAMILIES}
    return {"index.md": index_page(families)} | {f"{name}.md": family_page(family) for name, family in families.items()}


def index_page(families: Mapping[str, Family]) -> str:
    """The table of all families."""
    rows = [
        f"| [{name}]({name}.md) | {family.n_clients} | {family.backbone} | {family.max_episode_steps} | {family.description} |"
        for name, family in families.items()
    ]
    return "\n".join([
        "# Families\n",
        "A family is a list of clients whose environments differ. [Environments](../environments.md) explains their",
        "parameters and makes families of your own.\n",
        "| family | clients | backbone | steps an episode | what it is |",
        "|---|---|---|---|---|",
        *rows,
        "\n```{toctree}\n:hidden:\n",
        *families,
        "```\n",
    ])  # fmt: skip


def family_page(family: Family) -> str:
    """One family: its spaces, its clients with every number, how to use and to train it, and where its results are."""
    name, environment = family.name, family.make(0)
    observation, action = environment.observation_space, environment.action_space
    environment.close()
    settings = resolve("local", family)
    steps = settings.n_rounds * family.n_clients * settings.values["rollout_size"]
    facts = {
        "clients": family.n_clients,
        "world, backbone": f"`{family.world}`, `{family.backbone}`",
        "Gymnasium id": f"`{environment_id(name)}`",
        "observation": f"{observation.shape[0]} numbers",  # type: ignore[index]
        "action": f"{action.shape[0]} numbers in [{action.low.min():g}, {action.high.max():g}]",  # type: ignore
        "steps an episode": family.max_episode_steps,
        "a run, tuned": f"{settings.n_rounds} rounds of {settings.values['rollout_size']} steps a client, "
        f"{steps / 1e6:.3g} million steps of all clients together",
        "content hash": f"`{family.content_hash[:16]}`",
    }
    results = family_links(name, "../") or "None yet."
    return f"""# {name}

{family.description}

| | |
|---|---|
{_rows(facts)}

## Clients

{client_table(family)}

[Environments](../environments.md#{WORLDS[family.world]}) says what each parameter acts on.

## Example

```python
import gymnasium
import fed_envs

env = gymnasium.make("{environment_id(name)}", client={family.n_clients - 1})  # one client's MDP
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
env.close()

family = fed_envs.load_family("{name}")
print(family.client({family.n_clients - 1}))  # its parameters
```

`fed_envs.FederatedVecEnv("{name}")` has all clients side by side, and every algorithm takes `"{name}"` as its environment.

## Train

```
python train.py --algo fedguide-r --env {name}
python train.py --algo local --env {name}
python -m fed_envs.metadata show {name}
```

Methods that have settings for this family in `zoo_configs`: {_own_settings(family)}.

## Results

{results}

```
fedguide benchmark --algos local fedavg fedguide fedguide-r --envs {name} --seeds 0 1 2
```
"""


def _rows(facts: Mapping[str, object]) -> str:
    return "\n".join(f"| {name} | {value} |" for name, value in facts.items())


def client_table(family: Family) -> str:
    """A row for each parameter and a column for each client."""
    clients = [client.parameters() for client in family.clients]
    if len(clients[0]) == 1:  # a row for each client, where there is little to say of each
        (field,) = clients[0]
        rows = [f"| {client.client} | {_cell(client.parameters()[field])} |" for client in family.clients]
        return "\n".join([f"| client | `{field}` |", "|---|---|", *rows])
    head = "| | " + " | ".join(str(client.client) for client in family.clients) + " |"
    rows = [f"| `{field}` | " + " | ".join(_cell(client[field]) for client in clients) + " |" for field in clients[0]]
    return "\n".join([head, "|---" * (len(clients) + 1) + "|", *rows])


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list | tuple):
        inner = [f"({_cell(entry)})" if isinstance(entry, list | tuple) else _cell(entry) for entry in value]
        return ", ".join(inner)
    return str(value).replace("_", " ")


def _own_settings(family: Family) -> str:
    names = [name for name in ALGORITHMS if resolve(name, family).entry == family.name]
    return ", ".join(f"`{name}`" for name in names) if names else "none, all take their `default`"


def write_pages(folder: Path = DOCS / "families") -> None:
    """Write the pages whose content has changed."""
    folder.mkdir(exist_ok=True)
    for name, content in family_pages().items():
        file = folder / name
        if not file.exists() or file.read_text() != content:
            file.write_text(content)


if __name__ == "__main__":
    write_pages()
