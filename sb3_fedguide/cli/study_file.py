"""The file of a study: methods, their settings, families and seeds. Imports nothing heavy."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pydantic

from sb3_fedguide.cli.benchmark_arguments import AT_ROUNDS, BASELINE, FOLDER, check_once
from sb3_fedguide.cli.benchmark_results import SEEDS, TableRow
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.settings.config import CONFIGURATIONS, NESTED, read_yaml
from sb3_fedguide.settings.names import check_names
from sb3_fedguide.settings.pretraining import Count
from sb3_fedguide.settings.schema import check_model

Seed = Annotated[int, pydantic.Field(ge=0, lt=2**31)]
AtLeastOne = pydantic.Field(min_length=1)


class MethodEntry(pydantic.BaseModel):
    """A row of the study's tables: a method in one setting. Other entries are those of the whole study.

    :param algo: name of the algorithm; by default the row's own name
    :param conf: configuration: its name, or a YAML file beside the study's
    :param label: of its results; by default the configuration's name
    :param params: hyperparameters, over those of the whole study
    :param families: families with this row
    :param delays: as ``--delays`` of the training command
    """

    model_config = pydantic.ConfigDict(extra="forbid", strict=True)

    algo: str | None = None
    conf: str | None = None
    label: str | None = None
    params: dict[str, Any] = {}
    seeds: Annotated[list[Seed], AtLeastOne] | None = None
    families: Annotated[list[str], AtLeastOne] | None = None
    delays: str | None = None


class StudyFile(pydantic.BaseModel):
    """The file.

    :param title: of the study
    :param methods: name of a row to its :class:`MethodEntry`, or nothing
    :param families: of client environments, by name
    :param metadata: files of the user's own families, relative to the study's file
    :param rounds: of every run; by default those of the configuration
    :param eval_average: also evaluate the average of the clients' policies (Theorem 3), and keep the runs' folders
    :param baseline: row with score 1, the reference of differences and the speed-up
    :param at_rounds: rounds of the learning curve that tables show
    :param overview: columns that get their own table: a row per family, a column per method
    :param folder: of the results, relative to the study's file
    :param processes: runs at a time
    """

    model_config = pydantic.ConfigDict(extra="forbid", strict=True)

    title: str = ""
    methods: dict[str, dict[str, Any] | None] = {}
    families: list[str] = []
    metadata: list[str] = []
    seeds: Annotated[list[Seed], AtLeastOne] = list(SEEDS)
    rounds: Count | None = None
    conf: str = "tuned"
    label: str | None = None
    params: dict[str, Any] = {}
    delays: str | None = None
    eval_freq: Count | None = None
    eval_episodes: Count | None = None
    eval_average: bool = False
    baseline: str = BASELINE
    at_rounds: list[Count] = list(AT_ROUNDS)
    overview: list[str] = ["F"]
    folder: str | None = None
    processes: Count | None = None


@dataclass(frozen=True)
class Row:
    """A method in one setting.

    :param flags: of ``fedguide benchmark`` for its runs, without families and seeds
    """

    name: str
    algo: str
    label: str
    seeds: Sequence[int]
    families: Sequence[str] | None
    flags: Sequence[str]

    @property
    def in_tables(self) -> TableRow:
        return TableRow(self.name, self.algo, self.label, self.seeds, self.families)


@dataclass(frozen=True)
class Study:
    """A study, checked as far as possible without its families.

    :param name: of its file
    :param metadata: paths from here
    :param folder: of the results
    """

    name: str
    title: str
    rows: Sequence[Row]
    families: Sequence[str]
    metadata: Sequence[str]
    baseline: str
    at_rounds: Sequence[int]
    overview: Sequence[str]
    eval_freq: int | None
    eval_episodes: int | None
    eval_average: bool
    folder: str
    processes: int | None


def read_study(path: Path) -> Study:
    """:raises ValueError: one line, for a file that cannot be read or has an unknown or wrong entry"""
    if not path.is_file():
        raise ValueError(f"--study: there is no file {path}")
    try:
        return _study(path, read_yaml(path))
    except ValueError as error:
        message = str(error)
        raise ValueError(message if str(path) in message else f"{path}: {message}") from None


def _study(path: Path, content: Any) -> Study:
    from sb3_fedguide.cli.benchmark_tables import columns_of

    example = "a study has at least methods and families, e.g. {methods: {local: {}}, families: [HopperHard]}"
    if not isinstance(content, Mapping):
        raise ValueError(example)
    file = check_model("the study", StudyFile, content, {})
    assert isinstance(file, StudyFile)
    if not file.methods:
        raise ValueError(example)
    if not file.families and not file.metadata:
        raise ValueError("families is missing: give names such as [HopperHard], or metadata files")
    rows = [_row(path, file, name, entry or {}) for name, entry in file.methods.items()]
    check_names([file.baseline], [row.name for row in rows] + [BASELINE], "row as baseline:")
    check_names(file.overview, columns_of(), "column in overview:")
    return Study(
        name=path.stem,
        title=file.title,
        rows=rows,
        families=file.families,
        metadata=[_beside(path, name) for name in file.metadata],
        baseline=file.baseline,
        at_rounds=file.at_rounds,
        overview=file.overview,
        eval_freq=file.eval_freq,
        eval_episodes=file.eval_episodes,
        eval_average=file.eval_average,
        folder=FOLDER if file.folder is None else _beside(path, file.folder),
        processes=file.processes,
    )


def _row(path: Path, file: StudyFile, name: str, entry: Mapping[str, Any]) -> Row:
    own = check_model(f"method {name!r}", MethodEntry, entry, {})
    assert isinstance(own, MethodEntry)
    if not name.strip():
        raise ValueError(f"a method has the name {name!r}; give its row of the tables one, such as local")
    if "|" in name or "\n" in name:
        raise ValueError(f"method {name!r} becomes a row of a table; give it a name without | and line breaks")
    if own.algo is None and (first := name.split()[0]) in ALGORITHMS and first != name:
        raise ValueError(f"method {name!r} has no algorithm; give it algo: {first}")
    algo = own.algo or name
    check_names([algo], ALGORITHMS, f"algorithm of method {name!r}:" if own.algo else "algorithm")
    conf = own.conf or file.conf
    conf = conf if conf in CONFIGURATIONS or not Path(conf).suffix else _beside(path, conf)
    label = own.label or file.label or Path(conf).stem
    flags = ["-conf", conf, "--label", label]
    params = {**dict(_dotted(file.params)), **dict(_dotted(own.params))}
    flags += ["-params", *(_flag_value(name, key, value) for key, value in params.items())] if params else []
    given = {"rounds": file.rounds, "delays": own.delays or file.delays}
    for flag, value in given.items():
        flags += [] if value is None else [f"--{flag}", str(value)]
    seeds = file.seeds if own.seeds is None else own.seeds
    check_once(f"seeds of method {name!r}", seeds)
    return Row(name, algo, label, seeds, own.families, flags + ["--eval-average"] * file.eval_average)


def _beside(path: Path, name: str) -> str:
    """A path in the study's file is relative to the file's folder."""
    return os.path.normpath(path.parent / name)


def _dotted(params: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    for name, value in params.items():
        if name in NESTED and isinstance(value, Mapping):
            yield from ((f"{name}.{key}", part) for key, part in value.items())
        else:
            yield name, value


def _flag_value(method: str, key: str, value: Any) -> str:
    """A hyperparameter for ``-params``, as YAML that is read as the same value again.

    :raises ValueError: for a date and other YAML values that a hyperparameter cannot have
    """
    try:
        return f"{key}:{json.dumps(value, ensure_ascii=False)}"
    except TypeError:
        raise ValueError(
            f"method {method!r}: params.{key} must be made of numbers, texts, lists and mappings, but it is {value}"
        ) from None
