"""Finished training episodes: each client's own, their log, and SB3's buffers of all clients together."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from fed_envs.faults import ClientError


def truth(success: Any, client: int) -> bool:
    """:raises ClientError: for an ``is_success`` that is neither true nor false, such as an array"""
    try:
        return bool(success)
    except ValueError:
        raise ClientError([client], f"the is_success of its environment is neither true nor false: {success!r}") from None


class EpisodeStatistics(BaseAlgorithm):
    """Mixin of a federation: its clients' last finished episodes, and the round's log.

    SB3's ``ep_info_buffer`` and ``ep_success_buffer`` hold the last ones of all clients together, for callbacks that read
    them; the log uses each client's own, ``episode_infos``.
    """

    client_ids: list[int]
    #: environment steps of tests (:mod:`sb3_fedguide.common.screening`); ``num_timesteps`` does not count them
    test_steps = 0

    @property
    def environment_steps(self) -> int:
        """Steps of all clients together, in training and in tests of broadcasts."""
        return self.num_timesteps + self.test_steps

    def begin_episodes(self) -> None:
        """Forget all finished episodes."""
        #: of each client, with ``is_success`` if its environment reports it
        self.episode_infos: list[deque[dict[str, float]]] = [
            deque(maxlen=self._stats_window_size) for _ in range(len(self.client_ids))
        ]

    def note_episode(self, client: int, info: dict[str, Any]) -> None:
        """Remember a finished episode of the client at position ``client``.

        :param info: of its last step
        """
        if "episode" not in info:
            return
        success = info.get("is_success")
        episode = {name: info["episode"][name] for name in ("r", "l", "t")}  # other entries may be anything
        if success is not None:
            episode["is_success"] = float(truth(success, self.client_ids[client]))
        self.episode_infos[client].append(episode)
        self._share(episode)

    def gather_episodes(self) -> None:
        """Fill SB3's buffers from ``episode_infos``, if other processes played the episodes or after a resume."""
        assert self.ep_info_buffer is not None and self.ep_success_buffer is not None
        self.ep_info_buffer.clear()
        self.ep_success_buffer.clear()
        for episode in sorted((info for infos in self.episode_infos for info in infos), key=lambda info: info.get("t", 0.0)):
            self._share(episode)

    def _share(self, episode: dict[str, float]) -> None:
        if self.ep_info_buffer is None or self.ep_success_buffer is None:
            return  # in an engine's worker: nobody reads them there
        self.ep_info_buffer.append(episode)
        if "is_success" in episode:
            self.ep_success_buffer.append(episode["is_success"])

    def mean_episode_return(self) -> float:
        """Average over clients of their mean return over the last finished training episodes."""
        means = self._client_means("r")
        return float(np.mean(list(means.values()))) if means else float("nan")

    def _client_means(self, key: str) -> dict[int, float]:
        """Client id to the mean of ``key`` over its last finished episodes, for clients with any."""
        means = {}
        for client, infos in zip(self.client_ids, self.episode_infos, strict=True):
            values = [info[key] for info in infos if key in info]
            if values:
                means[client] = float(np.mean(values))
        return means

    def dump_logs(self, iteration: int = 0) -> None:
        """Write one round's log: each client is averaged first, so that those with short episodes do not dominate."""
        returns, lengths, successes = (self._client_means(key) for key in ("r", "l", "is_success"))
        for client, value in returns.items():
            self.record_client(client, "ep_rew_mean", value)
        if returns:
            self.logger.record("rollout/ep_rew_mean", self.mean_episode_return())
            self.logger.record("rollout/ep_len_mean", float(np.mean(list(lengths.values()))))
        if successes:
            self.logger.record("rollout/success_rate", float(np.mean(list(successes.values()))))
            for client, value in successes.items():
                self.record_client(client, "success_rate", value)
        elapsed = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        self.logger.record("time/round", iteration)
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.environment_steps, exclude="tensorboard")
        self.logger.dump(step=self.environment_steps)

    def record_client(self, client_id: int, key: str, value: float) -> None:
        """Log one client's value, but not on the terminal: long keys collide there, and eight clients fill it."""
        self.logger.record(f"client_{client_id}/{key}", value, exclude=("stdout", "log"))
