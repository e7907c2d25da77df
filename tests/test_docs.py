"""The documentation says what the code does: examples run, command lines parse, every method and family has its page."""

from __future__ import annotations

import importlib.util
import re
import shlex
import textwrap
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import pytest

import fed_envs
import sb3_fedguide
from fed_envs import FAMILIES, load_family
from sb3_fedguide.cli.arguments import train_parser
from sb3_fedguide.registry import ALGORITHMS, algorithm
from sb3_fedguide.settings.config import resolve
from tests.command_lines import blocks, check_command, commands

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md"), *(DOCS / "algorithms").glob("*.md")])
#: Pages all of whose Python examples are complete programs that take a moment.
PROGRAMS = [DOCS / name for name in ("first_federation.md", "how_to.md", "comparison.md")]
ACTIONS = {
    "Box": gym.spaces.Box(-1.0, 1.0, (2,)),
    "Discrete": gym.spaces.Discrete(3),
    "MultiDiscrete": gym.spaces.MultiDiscrete([2, 3]),
    "MultiBinary": gym.spaces.MultiBinary(2),
}


def _load_pages() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_pages", DOCS / "pages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pages() -> ModuleType:
    return _load_pages()


@pytest.fixture(scope="module")
def families(pages: ModuleType) -> dict[str, str]:
    """The families' pages as the site makes them."""
    return pages.family_pages()


def test_every_method_has_its_page():
    assert {path.stem for path in (DOCS / "algorithms").glob("*.md")} == {*ALGORITHMS, "index"}
    index = (DOCS / "algorithms" / "index.md").read_text()
    for name in ALGORITHMS:
        page = (DOCS / "algorithms" / f"{name}.md").read_text()
        headings = re.findall(r"^## (.+)$", page, re.MULTILINE)
        assert headings == [
            "Notes", "Can I use?", "Example", "Results", "How to replicate", "Parameters", "Differences to the original",
        ], name  # fmt: skip
        assert f"<!-- results of {name} -->" in page and f"<!-- parameters of {name} -->" in page
        assert f".. autoclass:: sb3_fedguide.{ALGORITHMS[name][1]}\n" in page
        assert f"]({name}.md) | `{name}` |" in index and re.search(rf"^{re.escape(name)}$", index, re.MULTILINE)


def test_every_family_has_its_page(families):
    assert set(families) == {f"{name}.md" for name in FAMILIES} | {"index.md"}
    for name in FAMILIES:
        family, page = load_family(name), families[f"{name}.md"]
        assert family.description in page and family.content_hash[:16] in page
        for field in family.clients[0].parameters():
            assert f"`{field}`" in page
        assert f"]({name}.md)" in families["index.md"]


def test_a_pages_parameters_are_the_constructors(pages):
    from sb3_fedguide.settings.schema import hyperparameters

    for name in ALGORITHMS:
        cls = algorithm(name)
        tables = dict(re.findall(r"^\| `(\w+)` \| (.*?) \| ", pages.parameter_tables(name), re.MULTILINE))
        documented = {*pages._own_parameters(cls), *tables}
        for parameter, (_, default) in hyperparameters(cls).items():
            if parameter not in documented:  # explained beside another: "like `clip_range_vf`"
                assert f"`{parameter}`" in pages.parameter_tables(name), f"{name}: {parameter}"
            elif parameter in tables:
                assert tables[parameter] in (f"`{default!r}`", ""), f"{name}: {parameter}"


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_example_of_a_method_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (example,) = blocks((DOCS / "algorithms" / f"{name}.md").read_text(), "python")
    exec(compile(example, f"{name}.md", "exec"), {"__name__": name})


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_method_takes_the_actions_that_its_page_names(name):
    page = (DOCS / "algorithms" / f"{name}.md").read_text()
    (row,) = re.findall(r"^\| actions \| (.*) \|$", page, re.MULTILINE)
    named = set(re.findall(r"`(\w+)`", row))
    taken = set()
    for kind, space in ACTIONS.items():

        class Env(gym.Env):
            observation_space, action_space = gym.spaces.Box(-1.0, 1.0, (3,)), space

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                return self.observation_space.sample(), {}

            def step(self, action):
                return self.observation_space.sample(), 0.0, False, True, {}

        try:
            algorithm(name)("MlpPolicy", [Env, Env], rollout_size=8, batch_size=4)
        except ValueError:
            continue
        taken.add(kind)
    assert named == taken


@pytest.mark.parametrize("name", FAMILIES)
def test_the_example_of_a_family_runs(name, families):
    (example,) = blocks(families[f"{name}.md"], "python")
    exec(compile(example, f"{name}.md", "exec"), {"__name__": name})


@pytest.mark.parametrize("package", [fed_envs, sb3_fedguide], ids=lambda package: package.__name__)
def test_the_example_of_a_docstring_runs(package, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    _, _, below = package.__doc__.partition("::\n")
    example = "\n".join(line for line in below.splitlines() if line.startswith("    ") or not line)
    exec(compile(textwrap.dedent(example), package.__name__, "exec"), {"__name__": "example"})


@pytest.mark.parametrize("page", PROGRAMS, ids=lambda page: page.name)
def test_the_examples_of_a_page_run(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number, example in enumerate(blocks(page.read_text(), "python")):
        exec(compile(example, f"{page.name}, example {number}", "exec"), {"__name__": "example"})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_examples_are_python(page):
    for example in blocks(page.read_text(), "python"):
        compile(example, page.name, "exec")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_command_lines_are_understood(page):
    for words in commands(page.read_text()):
        _check(words)


def test_command_lines_of_families_are_understood(families):
    for page in families.values():
        for words in commands(page):
            _check(words)


def _check(words: list[str]) -> None:
    try:
        check_command(words)
    except SystemExit as refusal:
        if refusal.code:
            pytest.fail(f"refused: {shlex.join(words)}")


def test_a_wrong_command_line_is_found():
    text = "```\npython train.py --algo fedavg --env HopperHard --round 3\n```\n"
    with pytest.raises(SystemExit):
        check_command(*commands(text))
    with pytest.raises(ValueError, match="no_such"):
        check_command(*commands("```\npython train.py --env HopperHard -params no_such:1\n```\n"))


def test_links_between_pages_lead_somewhere(pages):
    for page in PAGES:
        text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", text):
            path, _, anchor = target.partition("#")
            file = (page.parent / path).resolve() if path else page
            if file.parent == DOCS / "families":  # made by the site
                assert file.stem in (*FAMILIES, "index"), f"{page.name}: {target}"
                continue
            assert file.exists(), f"{page.name}: {target}"
            if anchor:
                headings = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
                assert anchor in map(pages.slug, headings), f"{page.name}: {target}"


def test_the_site_has_every_page():
    index = (DOCS / "index.md").read_text()
    for page in DOCS.glob("*.md"):
        if page.name != "index.md":
            assert re.search(rf"^(.* <)?{page.stem}>?$", index, re.MULTILINE), f"{page.name} is in no toctree of index.md"


def test_all_flags_of_training_are_documented():
    text = (DOCS / "command_line.md").read_text()
    for action in train_parser("")._actions:
        if action.dest != "help":
            assert any(f"`{option}" in text or f" {option}" in text for option in action.option_strings), action.dest


def test_the_flagships_settings_are_the_tuned_ones_on_every_page() -> None:
    """The table of sharing.md, and every page that says when clients are on their own again."""
    tuned = resolve("fedguide-r", load_family("HopperHard")).values
    text = (DOCS / "sharing.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| [^|]* \| ([^|]*) \|", text, re.MULTILINE)
    said = {name: value.strip().strip("`") for name, value in rows}
    assert {"normalize", "server_step", "mix", "n_epochs", "screening"} <= said.keys()
    for name, value in said.items():
        assert str(tuned[name]) in (value, f"{value}.0"), name
    for page in ("concepts.md", "algorithms/fedguide-r.md", "sharing.md"):
        assert set(re.findall(r"until_[\d.]+\d", (DOCS / page).read_text(encoding="utf-8"))) == {tuned["mix"]}, page
