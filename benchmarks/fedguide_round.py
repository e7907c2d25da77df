"""What the prior costs: seconds of a FedGuide round while lambda2 > 0 against a Local round, and the error of its subsample.

    python benchmarks/fedguide_round.py --env HopperHard

FedGuide runs with the tuned settings (its offline stage comes from the cache, or is made first), once with ``sample`` and
once with ``snis`` on 512 states. The rounds are taken in turn with those of Local, evaluation apart. Then, on one rollout,
the gradient of the ``snis`` loss with respect to the actors' means is compared between random subsets of its states and all of
them. Writes ``benchmarks/results/fedguide_round_<env>.json``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import torch as th
from record import spread, write_result

from fed_envs import load_family
from sb3_fedguide.algorithms.fedguide import FedGuide
from sb3_fedguide.seeding import Role
from sb3_fedguide.settings.config import resolve

SUBSETS = (128, 256, 512, 1024)


def make(algo: str, args: argparse.Namespace, **overrides: Any) -> Any:
    family = load_family(args.env)
    given = {"n_envs_per_client": args.n_envs_per_client, **overrides}
    model = resolve(algo, family, "tuned", args.env, given).make(family, seed=0, cache_dir=args.cache_dir)
    model.pretrain(progress_bar=True)
    return model


def timed_round(model: Any) -> float:
    started = time.perf_counter()
    model.learn(model.rollout_size * model.n_clients, reset_num_timesteps=False)
    return time.perf_counter() - started


def gradients(model: FedGuide, n_states: int | None, draw: int) -> np.ndarray:
    """Gradient of the ``snis`` loss by the actors' parameters, one row per client."""
    model.prior_states = n_states
    model._streams.pop(Role.PRIOR, None)
    for _, rng in model.present_streams(Role.PRIOR):
        rng.bit_generator.advance(draw * 10**6)  # type: ignore[attr-defined]
    with th.no_grad():
        model._prepare_importance_weights()
    buffer = model.rollout_buffer
    mean = model.policy.actor_mean(th.as_tensor(buffer.rows(buffer.observations)))
    std = model.policy.log_std.detach().exp().unsqueeze(1)
    log_prob = (-0.5 * ((th.as_tensor(buffer.rows(buffer.actions)) - mean) / std) ** 2).sum(dim=-1)
    actor = [p for name, p in model.policy.named_parameters() if name.startswith(("mlp_extractor.policy_net", "action_net"))]
    loss = -(buffer.extras["prior_weights"] * log_prob).mean(dim=1).sum()
    return th.cat([g.flatten(1) for g in th.autograd.grad(loss, actor)], dim=1).numpy()


def subsample_errors(model: FedGuide, draws: int) -> dict[str, Any]:
    """Relative error and cosine of the subset's gradient against that of all states: mean over clients and draws."""
    full = gradients(model, None, 0)
    table = {}
    for n_states in SUBSETS:
        parts = np.stack([gradients(model, n_states, draw + 1) for draw in range(draws)])
        distance = np.linalg.norm(parts - full, axis=-1) / np.linalg.norm(full, axis=-1)
        cosine = (parts * full).sum(axis=-1) / (np.linalg.norm(parts, axis=-1) * np.linalg.norm(full, axis=-1))
        table[str(n_states)] = {"relative_error": float(distance.mean()), "cosine": float(cosine.mean())}
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HopperHard")
    parser.add_argument("--n-envs-per-client", type=int, default=1)
    parser.add_argument("--cache-dir", help="of the offline stage")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--draws", type=int, default=4, help="subsets of each size")
    args = parser.parse_args()
    th.set_num_threads(1)

    models = {
        "local": make("local", args),
        "sample": make("fedguide", args, prior_loss="sample"),
        "snis": make("fedguide", args, prior_loss="snis", prior_states=512),
    }
    for model in models.values():
        timed_round(model)
    seconds: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(args.repeats):
        for name, model in models.items():
            seconds[name].append(timed_round(model))
    ratios = {
        name: spread([ours / local for ours, local in zip(seconds[name], seconds["local"], strict=True)])
        for name in ("sample", "snis")
    }
    errors = subsample_errors(models["snis"], args.draws)
    table = {name: spread(values) for name, values in seconds.items()}
    suffix = f"_x{args.n_envs_per_client}" if args.n_envs_per_client > 1 else ""
    command = {name: value for name, value in vars(args).items() if name != "cache_dir"}  # says nothing of the figures
    result = {"command": command, "seconds": table, "ratio_to_local": ratios, "snis_gradient": errors}
    write_result(f"fedguide_round_{args.env}{suffix}", result)
    for name, values in table.items():
        print(f"{name:8} {values['median']:6.2f} s a round ({values['min']:.2f} to {values['max']:.2f})")
    for name, values in ratios.items():
        print(f"{name} / local {values['median']:.2f} ({values['min']:.2f} to {values['max']:.2f})")
    for n_states, error in errors.items():
        print(f"snis on {n_states:>4} states: relative error {error['relative_error']:.2f}, cosine {error['cosine']:.2f}")


if __name__ == "__main__":
    main()
