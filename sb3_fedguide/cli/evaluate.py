"""The evaluation command: a finished run's policies, client by client, in seeded episodes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_fedguide.cli.arguments import OneLineParser
from sb3_fedguide.cli.output import pipe_may_close
from sb3_fedguide.cli.pretrained import find_run
from sb3_fedguide.cli.rendering import check_rendering
from sb3_fedguide.cli.saved_run import in_place, load_model, read_run
from sb3_fedguide.cli.video import FORMATS, check_format, write_videos
from sb3_fedguide.settings.packages import import_packages

if TYPE_CHECKING:
    import numpy as np

    from fed_envs import Family
    from sb3_fedguide.common.evaluation import Evaluation
    from sb3_fedguide.common.federation import Federation
    from sb3_fedguide.settings.config import Config


@pipe_may_close
def main(argv: Sequence[str] | None = None, prog: str = "fedguide evaluate") -> int:
    """Run the command.

    :return: the exit code: 0, or 2 for wrong input
    """
    parser = _parser(prog)
    arguments = parser.parse_args(argv)
    try:
        import_packages(arguments.gym_packages)
        _check(arguments)
        arguments.run = str(find_run(arguments.run))
        run, config, family = _read_run(arguments)
        model = load_model(Path(arguments.run), config, family)
        policies = _policies(arguments, Path(arguments.run), model)
        if arguments.video is not None:
            check_rendering(family, "--video")
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    result = _evaluate(arguments, run, family, model, policies)
    text = json.dumps(result, indent=2)
    if arguments.output is None:
        print(text)
    else:
        from sb3_fedguide.cli.run_folder import write_text
        from sb3_fedguide.common.digits import shown

        write_text(Path(arguments.output), text + "\n")
        for name, values in result["policies"].items():
            print(f"{name}: average {shown(values['average'])}, worst client {shown(values['worst_client'])}")
    return 0


def _parser(prog: str) -> OneLineParser:
    from sb3_fedguide.seeding import EVALUATION_SEED

    parser = OneLineParser(prog=prog, description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    flag = parser.add_argument
    flag("run", metavar="RUN", help="folder of a run, e.g. logs/fedguide/HopperHard_1, or the name of a "
         "run in this package, e.g. Bandit2D")  # fmt: skip
    flag("--policy", choices=("deployed", "broadcast", "both"), default="both", help="the clients' own policies after "
         "local training, the policies that the server sent then, or both if they differ")  # fmt: skip
    flag("--episodes", type=int, default=10, metavar="N", help="episodes per client")
    flag(
        "--seed",
        type=int,
        default=EVALUATION_SEED,
        help="random seed of the episodes; by default that of the evaluations during training",
    )
    flag("--gym-packages", nargs="+", default=[], metavar="MODULE", help="modules to import first; they register your own "
         "algorithms")  # fmt: skip
    flag("--stochastic", action="store_true", help="sample actions instead of taking their mean")
    flag("-o", "--output", metavar="FILE", help="write the JSON there instead of to the terminal")
    flag("--video", metavar="DIR", help="write a video of one deterministic episode of each client there, apart from "
         "the evaluated ones")  # fmt: skip
    flag("--video-format", choices=FORMATS, default="gif", help="gif, or mp4, which needs pip install 'sb3-fedguide[video]'")
    return parser


def _read_run(arguments: argparse.Namespace) -> tuple[dict[str, Any], Config, Family]:
    """:raises ValueError: if the folder is not that of a trained run, or needs a module for its algorithm or world"""
    from sb3_fedguide.settings.config import read_yaml

    folder = Path(arguments.run)
    try:
        return read_run(folder)
    except ValueError as error:
        flags = read_yaml(folder / "args.yml") if (folder / "args.yml").is_file() else {}
        modules = flags.get("gym_packages") if isinstance(flags, dict) else None
        if not isinstance(modules, list) or set(map(str, modules)) <= set(arguments.gym_packages):
            raise
        needed = " ".join(map(str, modules))
        raise ValueError(f"{error}; the run was trained with --gym-packages {needed}: give it here as well") from None


def _check(arguments: argparse.Namespace) -> None:
    if arguments.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, not {arguments.episodes}")
    if not 0 <= arguments.seed < 2**31:
        raise ValueError(f"--seed must lie in [0, 2^31), not {arguments.seed}")
    if arguments.output is not None and not Path(arguments.output).absolute().parent.is_dir():
        raise ValueError(f"--output: there is no folder {Path(arguments.output).parent}")
    if arguments.video is not None:
        from sb3_fedguide.cli.run_folder import check_log_folder

        check_log_folder(Path(arguments.video), "video folder", "--video")
        check_format(arguments.video_format)


def _policies(arguments: argparse.Namespace, folder: Path, model: Federation) -> dict[str, dict[str, np.ndarray]]:
    """The policies to evaluate: name to the parameters that replace the saved model's (none for its own).

    :raises ValueError: if the file of deployed policies is damaged or another model's
    """
    import numpy as np

    from sb3_fedguide.cli.saved_run import read_deployed_policies

    deployed = read_deployed_policies(folder, model)
    own = model.acting_arrays()
    if all(np.array_equal(array, own[name]) for name, array in deployed.items() if not name.startswith("normalizer/")):
        # the exchange did not change the policies, or only their observation statistics: each client has one policy
        if arguments.policy == "broadcast":
            raise ValueError("the last exchange sent no policies, so there is no broadcast policy; leave --policy out")
        return {"deployed": deployed}
    found = {"deployed": deployed, "broadcast": {}}
    return found if arguments.policy == "both" else {arguments.policy: found[arguments.policy]}


def _evaluate(
    arguments: argparse.Namespace,
    run: dict[str, Any],
    family: Family,
    model: Federation,
    policies: dict[str, dict[str, np.ndarray]],
) -> dict[str, Any]:
    from sb3_fedguide.common.evaluation import evaluate_federation, evaluation_env

    deterministic = not arguments.stochastic
    if arguments.stochastic:
        model.set_random_seed(arguments.seed)  # type: ignore[attr-defined]
    results = {}
    for name, arrays in policies.items():
        env = evaluation_env(model, arguments.episodes)
        with in_place(model, arrays):
            results[name] = _numbers(
                evaluate_federation(lambda obs: model.predict(obs, deterministic=deterministic)[0], env, arguments.seed)
            )
            if arguments.video is not None:
                written = write_videos(
                    Path(arguments.video), name, run["algo"], family, model, arguments.seed, arguments.video_format
                )
                print(*(f"wrote {path}" for path in written), sep="\n", file=sys.stderr)
        env.close()
    return {
        "run": str(arguments.run),
        "algo": run["algo"],
        "env": run["env"],
        "rounds_done": run["rounds_done"],
        "clients": model.client_ids,
        "n_episodes": arguments.episodes,
        "seed": arguments.seed,
        "deterministic": deterministic,
        "policies": results,
    }


def _numbers(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "average": evaluation.average,
        "worst_client": evaluation.worst_client,
        "client_returns": evaluation.client_returns.tolist(),
        "client_return_std": evaluation.returns.std(axis=1).tolist(),
        "success_rates": evaluation.success_list,
        "client_lengths": evaluation.lengths.mean(axis=1).tolist(),
        "returns": evaluation.returns.tolist(),
    }
