"""New families of any size from the presets of the shipped ones.

The Hopper, Walker2D and Reacher presets and the order of their random draws are the paper's: eight clients with the paper's
seed (:data:`PAPER_SEEDS`) are the shipped families to the printed digit. The HalfCheetah jitter is ours, since the draws
behind the paper's HalfCheetah clients are not known; ranges and presets follow its figures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fed_envs.clients import BANDIT2D_PEAKS
from fed_envs.mazes import MAZES, distances, free_cells
from fed_envs.metadata import SCHEMA_VERSION, Family, load_family, parse_family
from fed_envs.registration import FAMILIES

#: Seeds that give back the paper's families (eight clients).
PAPER_SEEDS = {"Hopper": 2026, "HopperHard": 2026, "Walker2D": 2026, "Walker2DHard": 2026, "Reacher": 42, "ReacherHard": 42}

#: Likewise for families that are ours.
OWN_SEEDS = {"PointMaze": 2026, "PointMazeHard": 2026}

_DYNAMICS_FIELDS = ("mass_scale", "damping_scale", "friction_scale", "action_gain")


@dataclass(frozen=True)
class LeggedPresets:
    """Presets of Hopper and Walker2D and the ranges of the uniform factors on them."""

    dynamics: dict[str, tuple[float, float, float, float]]  # mass, damping, friction, gain
    preferences: dict[str, tuple[float, float, float]]  # forward weight, control cost factor, instability weight
    dynamics_jitter: tuple[tuple[float, float], ...]  # one range per dynamics field
    forward_jitter: tuple[float, float]
    ctrl_jitter: tuple[float, float]
    instability_jitter: tuple[float, float]
    reset_jitter: tuple[float, float]


LEGGED = LeggedPresets(
    dynamics={
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "heavy": (1.4, 1.1, 1.05, 0.95),
        "weak_actuator": (1.0, 0.85, 0.95, 0.8),
        "high_damping_friction": (1.05, 1.25, 1.3, 0.9),
    },
    preferences={"speed": (1.1, 1.0, 0.0), "efficiency": (1.0, 1.5, 0.0), "stability": (1.0, 1.2, 0.02)},
    dynamics_jitter=((0.95, 1.05), (0.9, 1.1), (0.9, 1.1), (0.9, 1.1)),
    forward_jitter=(0.9, 1.1),
    ctrl_jitter=(0.8, 1.2),
    instability_jitter=(0.5, 1.5),
    reset_jitter=(0.9, 1.1),
)
LEGGED_HARD = LeggedPresets(
    dynamics={
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "very_heavy": (1.65, 1.2, 1.1, 0.85),
        "very_weak_actuator": (1.0, 0.7, 0.85, 0.55),
        "extreme_damping_friction": (1.1, 1.55, 1.65, 0.8),
        "low_friction": (1.0, 0.85, 0.45, 0.9),
        "heavy_low_damping": (1.5, 0.65, 0.95, 0.9),
        "weak_low_friction": (1.0, 0.9, 0.55, 0.65),
        "inverted_dynamics": (0.75, 1.4, 1.45, 0.75),
    },
    preferences={
        "sprint": (1.3, 0.7, 0.0),
        "miser": (0.85, 3.0, 0.0),
        "tightrope": (0.95, 1.5, 0.05),
        "explorer": (1.1, 1.0, 0.01),
    },
    dynamics_jitter=((0.85, 1.15),) * 4,
    forward_jitter=(0.8, 1.2),
    ctrl_jitter=(0.65, 1.35),
    instability_jitter=(0.4, 1.6),
    reset_jitter=(0.8, 1.2),
)


@dataclass(frozen=True)
class CheetahPresets:
    """Means of HalfCheetah's presets and the standard deviations of the Gaussians around them, clipped at two of them."""

    dynamics: dict[str, tuple[float, float, float, float]]
    preferences: dict[str, tuple[float, float, float]]  # forward weight, control cost, instability weight
    dynamics_std: float
    forward_std: float
    ctrl_std: float
    instability_std: float
    reset: tuple[float, float]  # mean and standard deviation


CHEETAH = CheetahPresets(
    dynamics={
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "heavy_body": (1.08, 1.02, 1.02, 0.98),
        "weak_actuator": (1.0, 1.01, 1.0, 0.92),
        "high_damping_friction": (1.02, 1.1, 1.12, 0.98),
    },
    preferences={"speed": (1.05, 0.09, 0.0), "efficiency": (0.98, 0.11, 0.0), "stability": (0.97, 0.105, 0.0)},
    dynamics_std=0.03,
    forward_std=0.02,
    ctrl_std=0.008,
    instability_std=0.0,
    reset=(0.1, 0.01),
)
CHEETAH_HARD = CheetahPresets(
    dynamics={
        "nominal": (1.0, 1.0, 1.0, 1.0),
        "heavy_body": (1.2, 1.05, 1.02, 0.98),
        "weak_actuator": (1.0, 1.02, 1.0, 0.8),
        "high_damping_friction": (1.03, 1.3, 1.25, 0.97),
    },
    preferences={"speed": (1.12, 0.085, 0.012), "efficiency": (0.98, 0.145, 0.014), "stability": (0.96, 0.115, 0.035)},
    dynamics_std=0.06,
    forward_std=0.05,
    ctrl_std=0.012,
    instability_std=0.004,
    reset=(0.11, 0.02),
)


def _digits(value: float) -> float:
    """Seven significant digits, as the paper's files have."""
    return float(f"{value:.7g}")


def _decimals(*values: float) -> list[float]:
    """Six decimals without negative zeros, as the paper's files have for points and boxes."""
    return [round(float(value), 6) + 0.0 for value in values]


def _legged_clients(presets: LeggedPresets, n_clients: int, seed: int) -> list[dict[str, Any]]:
    random = np.random.RandomState(seed)  # the paper's generator
    clients = []
    for k in range(n_clients):
        dynamics = list(presets.dynamics)[k % len(presets.dynamics)]
        preference = list(presets.preferences)[k % len(presets.preferences)]
        forward, ctrl, instability = presets.preferences[preference]
        scales = [
            value * random.uniform(*jitter)
            for value, jitter in zip(presets.dynamics[dynamics], presets.dynamics_jitter, strict=True)
        ]
        clients.append(
            {
                "client": k,
                "dynamics": dynamics,
                "preference": preference,
                **{field: _digits(value) for field, value in zip(_DYNAMICS_FIELDS, scales, strict=True)},
                "forward_reward_weight": _digits(forward * random.uniform(*presets.forward_jitter)),
                "ctrl_cost_weight": _digits(1e-3 * ctrl * random.uniform(*presets.ctrl_jitter)),
                "instability_cost_weight": _digits(instability * random.uniform(*presets.instability_jitter)),
                "reset_noise_scale": _digits(5e-3 * random.uniform(*presets.reset_jitter)),
            }
        )
    return clients


def _cheetah_clients(presets: CheetahPresets, n_clients: int, seed: int) -> list[dict[str, Any]]:
    random = np.random.RandomState(seed)

    def near(mean: float, std: float) -> float:
        return round(mean + std * float(np.clip(random.standard_normal(), -2.0, 2.0)), 4)

    clients = []
    for k in range(n_clients):
        dynamics = list(presets.dynamics)[k % len(presets.dynamics)]
        preference = list(presets.preferences)[k % len(presets.preferences)]
        forward, ctrl, instability = presets.preferences[preference]
        clients.append(
            {
                "client": k,
                "dynamics": dynamics,
                "preference": preference,
                **{
                    field: near(mean, presets.dynamics_std)
                    for field, mean in zip(_DYNAMICS_FIELDS, presets.dynamics[dynamics], strict=True)
                },
                "forward_reward_weight": near(forward, presets.forward_std),
                "ctrl_cost_weight": near(ctrl, presets.ctrl_std),
                "instability_cost_weight": near(instability, presets.instability_std),
                "reset_noise_scale": near(*presets.reset),
            }
        )
    return clients


def _reacher_clients(hard: bool, n_clients: int, seed: int) -> list[dict[str, Any]]:
    random = np.random.RandomState(seed)  # the paper's generator
    preferences = ("default", "speed", "stability", "efficiency")
    clients = []
    for k in range(n_clients):
        degrees = 360.0 * k / n_clients
        # The box around the sector's corners: radii 0.15 to 0.21 m, 15 degrees to either side.
        corners = [
            (radius * math.cos(angle), radius * math.sin(angle))
            for radius in (0.15, 0.21)
            for angle in (math.radians(degrees - 15.0), math.radians(degrees + 15.0))
        ]
        goal_x, goal_y = zip(*corners, strict=True)
        client: dict[str, Any] = {
            "client": k,
            "goal_angle_deg": _digits(degrees),
            "goal_x": _decimals(min(goal_x), max(goal_x)),
            "goal_y": _decimals(min(goal_y), max(goal_y)),
            "action_offset": _decimals(*np.clip(random.normal(0.0, 0.8, 2), -1.0, 1.0)),
            "reward_scale": _digits(random.uniform(0.6, 1.6)),
            "angle_offset": _digits(random.uniform(-0.2, 0.2)),
        }
        if hard:
            client["preference"] = preferences[k % len(preferences)]
            for field in ("mass_scale", "damping_scale", "gear_scale"):
                client[field] = _digits(random.uniform(0.5, 2.0))
        clients.append(client)
    return clients


def _bandit2d_clients(n_clients: int, seed: int) -> list[dict[str, Any]]:
    """Client ``c`` owns peak ``c mod 4``; nothing is random."""
    return [{"client": k, "peak": list(BANDIT2D_PEAKS[k % len(BANDIT2D_PEAKS)])} for k in range(n_clients)]


def _point_maze_clients(hard: bool, n_clients: int, seed: int) -> list[dict[str, Any]]:
    """Goals take a maze's free cells in a random order; hard clients have mazes in turn and start in a few cells."""
    random = np.random.default_rng(seed)
    mazes = ("Open", "UMaze", "Medium", "Large") if hard else ("Open",)
    gears, dampings = ((0.4, 1.5), (0.5, 20.0)) if hard else ((0.6, 1.2), (0.5, 5.0))
    orders = {maze: random.permutation(free_cells(MAZES[maze])).tolist() for maze in mazes}
    clients = []
    for k in range(n_clients):
        maze = mazes[k % len(mazes)]
        goal = orders[maze][k // len(mazes) % len(orders[maze])]
        client: dict[str, Any] = {"client": k, "maze": maze, "goal_cells": [goal]}
        if hard:
            steps = distances(MAZES[maze], (goal[0], goal[1]))
            middles = [cell for cell, distance in steps.items() if 3 <= distance <= 5]
            region = distances(MAZES[maze], middles[random.integers(len(middles))])
            client["start_cells"] = sorted([*cell] for cell, distance in region.items() if distance <= 1)
        for field, (low, high) in (("gear_scale", gears), ("damping_scale", dampings)):
            client[field] = _digits(math.exp(random.uniform(math.log(low), math.log(high))))
        client["reward_scale"] = _digits(random.uniform(0.6, 1.6))
        clients.append(client)
    return clients


_GENERATORS: dict[str, Callable[[int, int], Sequence[dict[str, Any]]]] = {
    "Bandit2D": _bandit2d_clients,
    "Reacher": lambda n_clients, seed: _reacher_clients(False, n_clients, seed),
    "ReacherHard": lambda n_clients, seed: _reacher_clients(True, n_clients, seed),
    "Hopper": lambda n_clients, seed: _legged_clients(LEGGED, n_clients, seed),
    "HopperHard": lambda n_clients, seed: _legged_clients(LEGGED_HARD, n_clients, seed),
    "Walker2D": lambda n_clients, seed: _legged_clients(LEGGED, n_clients, seed),
    "Walker2DHard": lambda n_clients, seed: _legged_clients(LEGGED_HARD, n_clients, seed),
    "HalfCheetah": lambda n_clients, seed: _cheetah_clients(CHEETAH, n_clients, seed),
    "HalfCheetahHard": lambda n_clients, seed: _cheetah_clients(CHEETAH_HARD, n_clients, seed),
    "PointMaze": lambda n_clients, seed: _point_maze_clients(False, n_clients, seed),
    "PointMazeHard": lambda n_clients, seed: _point_maze_clients(True, n_clients, seed),
}


def generate_family(family: str, n_clients: int, seed: int = 0, name: str | None = None) -> Family:
    """A new family from the presets of a shipped one.

    :param family: the shipped family whose world and presets to use
    :param n_clients: how many clients; presets repeat in turn, sectors and jitter do not
    :param seed: of the jitter; the same seed gives the same family
    :param name: the new family's name, by default e.g. ``HopperHard_16_seed1``
    :raises ValueError: for an unknown family, fewer than one client, a negative seed or a name that is no identifier
    """
    shipped = load_family(family) if family in FAMILIES else None
    if shipped is None or family not in _GENERATORS:
        raise ValueError(f"no presets for {family!r}; they exist for {', '.join(_GENERATORS)}")
    if n_clients < 1:
        raise ValueError(f"a family needs at least one client, got {n_clients}")
    if not 0 <= seed < 2**32:
        raise ValueError(f"the seed must lie between 0 and 2**32 - 1, got {seed}")
    content = {
        "schema_version": SCHEMA_VERSION,
        "family": name or f"{family}_{n_clients}_seed{seed}",
        "world": shipped.world,
        "backbone": shipped.backbone,
        "max_episode_steps": shipped.max_episode_steps,
        "description": f"{n_clients} clients from the presets of {family}, seed {seed}.",
        "clients": list(_GENERATORS[family](n_clients, seed)),
    }
    return parse_family(content, f"the generated family {content['family']}")
