"""One episode of a client's policy, and pictures of chosen steps of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from sb3_fedguide.seeding import EVALUATION_SEED

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from fed_envs import Family

#: Poses of a body in one picture.
N_POSES = 7
#: Metres of ground that a picture of a walking body shows, from where it starts; and what it shows behind it.
GROUND, BEHIND = 3.4, 0.6
#: Metres that a picture of Reacher shows.
ARENA = 0.52


@dataclass(frozen=True)
class Episode:
    """A deterministic episode.

    :param client: its number
    :param observations: raw, ``(n_steps + 1, ...)``; empty for dictionaries
    :param actions: ``(n_steps, ...)``
    :param positions: horizontal position of a walking body, ``(n_steps + 1,)``; empty in other worlds
    :param rewards: ``(n_steps,)``
    :param seconds: simulated, of a step; 0 where the environment does not say
    :param rate: steps per second of a video that shows them at their own speed
    :param seed: of its start
    """

    client: int
    observations: np.ndarray
    actions: np.ndarray
    positions: np.ndarray
    rewards: np.ndarray
    seconds: float
    rate: float
    seed: int

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def episode_return(self) -> float:
        return float(self.rewards.sum())


@dataclass(frozen=True)
class Poses:
    """Pictures of one episode.

    :param frames: ``(n_pictures, height, width, 3)`` uint8
    :param background: the same without what moves, ``(height, width, 3)``; ``None`` if it was not drawn
    """

    frames: np.ndarray
    background: np.ndarray | None


def record(
    family: Family, client: int, policy: BaseAlgorithm, seed: int = EVALUATION_SEED, max_steps: int = 10_000
) -> Episode:
    """Play one episode without drawing anything.

    :param policy: acts on raw observations, as :meth:`Federation.client` gives it
    :param max_steps: after which an episode that does not end is cut
    """
    env = family.make(client)
    walks = family.world == "locomotion"
    body: Any = env.unwrapped
    obs, _ = env.reset(seed=seed)
    observations: list[Any] = [obs]
    actions: list[Any] = []
    rewards: list[float] = []
    positions = [_position(body)] if walks else []
    done = False
    while not done and len(actions) < max_steps:
        action = policy.predict(obs, deterministic=True)[0]
        obs, reward, terminated, truncated, _ = env.step(action)
        observations.append(obs)
        actions.append(action)
        if walks:
            positions.append(_position(body))
        rewards.append(float(reward))
        done = terminated or truncated
    seconds, rate = float(getattr(body, "dt", 0.0)), float(env.metadata.get("render_fps", 30))
    env.close()
    plain = np.array(observations) if isinstance(obs, np.ndarray) else np.empty(0)
    return Episode(client, plain, np.array(actions), np.array(positions), np.array(rewards), seconds, rate, seed)


def _position(body: Any) -> float:
    return float(body.data.qpos[0])


def pose_steps(episode: Episode, n_poses: int = N_POSES) -> list[int]:
    """Steps to draw, evenly spaced: of the whole episode, or while a walking body is on the ground that the picture shows."""
    last = len(episode)
    if len(episode.positions):
        way = episode.positions - episode.positions[0]
        outside = np.flatnonzero((way > GROUND) | (way < -BEHIND))
        last = int(outside[0]) if len(outside) else last
    return evenly(last, n_poses)


def evenly(last: int, n: int) -> list[int]:
    """Up to ``n`` steps from 0 to ``last``, with both, evenly spaced."""
    return sorted({round(step) for step in np.linspace(0, last, n)})


def pictures(family: Family, episode: Episode, steps: Sequence[int]) -> Iterator[np.ndarray]:
    """Pictures of an episode after ``steps`` of its steps, by playing its actions again; one at a time.

    :return: ``(height, width, 3)`` uint8
    """
    env = family.make(episode.client, render_mode="rgb_array")
    try:
        yield from _photographs(env, episode, steps)
    finally:
        env.close()


def poses(family: Family, episode: Episode, steps: Sequence[int], size: tuple[int, int]) -> Poses:
    """Pictures to combine into one with many poses.

    A fixed camera shows a walking body, and Reacher's arm from above.

    :param size: width and height in pixels; worlds that choose theirs keep it
    """
    camera = _CAMERAS[family.world](episode, size) if family.world in _CAMERAS else None
    sized = {"width": size[0], "height": size[1], "camera": camera} if family.world in _SIZED else {}
    env = family.make(episode.client, render_mode="rgb_array", **sized)
    frames = np.stack(list(_photographs(env, episode, steps)))
    background = None
    if camera is not None:
        body: Any = env.unwrapped
        body.model.geom_rgba[body.model.geom_bodyid > 0, 3] = 0.0  # all that moves
        background = np.asarray(env.render(), dtype=np.uint8)
    env.close()
    return Poses(frames, background)


def _photographs(env: gymnasium.Env, episode: Episode, steps: Sequence[int]) -> Iterator[np.ndarray]:
    env.reset(seed=episode.seed)
    for step in range(max(steps) + 1):
        if step:
            env.step(episode.actions[step - 1])
        if step in steps:
            yield np.asarray(env.render(), dtype=np.uint8)


def _from_the_side(episode: Episode, size: tuple[int, int]) -> dict[str, Any]:
    width = GROUND + 2 * BEHIND
    middle = episode.positions[0] + width / 2 - BEHIND
    return {"lookat": np.array([middle, 0.0, 0.85]), "distance": _distance(width * size[1] / size[0]), "azimuth": 90.0,
            "elevation": -6.0}  # fmt: skip


def _from_above(episode: Episode, size: tuple[int, int]) -> dict[str, Any]:
    return {"lookat": np.zeros(3), "distance": _distance(ARENA), "azimuth": 90.0, "elevation": -90.0}


def _distance(height: float) -> float:
    """Distance from which a camera with MuJoCo's default angle of view sees ``height`` metres."""
    return height / (2 * np.tan(np.radians(45.0) / 2))


_SIZED = ("locomotion", "reacher", "metaworld10")
_CAMERAS = {"locomotion": _from_the_side, "reacher": _from_above}


def overlay(poses: Poses, faintest: float = 0.25, threshold: int = 14) -> np.ndarray:
    """All poses in one picture: later poses are more opaque.

    Without a background, the median over the pictures replaces it.

    :param faintest: how opaque the first pose is; the last is opaque
    :param threshold: difference from the background from which a pixel belongs to a pose
    :return: ``(height, width, 3)`` uint8
    """
    frames = poses.frames
    background = np.median(frames, axis=0) if poses.background is None else poses.background.astype(float)
    picture = background.copy()
    for frame, strength in zip(frames, np.linspace(faintest, 1.0, len(frames)) if len(frames) > 1 else [1.0], strict=True):
        pose = np.abs(frame - background).max(axis=-1) > threshold
        picture[pose] += strength * (frame[pose] - picture[pose])
    return picture.round().astype(np.uint8)
