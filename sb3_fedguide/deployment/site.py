"""A client's machine in a real federation: one client, its disk, and answers to the server's messages."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

import sb3_fedguide
from fed_envs.plain_data import State, freeze, thaw
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.common.evaluation import Evaluation, FederatedEvalCallback, evaluation_env
from sb3_fedguide.common.faults import in_round
from sb3_fedguide.common.federation import Federation
from sb3_fedguide.deployment.clients import RUN_FACTS, SERVER_FACTS, difference
from sb3_fedguide.deployment.transport import KINDS, RUN, UNPREPARED, Message
from sb3_fedguide.offline.trunk import TrunkTraining, observation_moments
from sb3_fedguide.registry import algorithm_name
from sb3_fedguide.server.metrics import ClientEvaluation
from sb3_fedguide.server.payload import Payload
from sb3_fedguide.server.trunk import MOMENTS, TRUNK
from sb3_fedguide.settings.evaluation import EVAL_EPISODES, EVAL_FREQ, broadcast_is_due
from sb3_fedguide.state.array_files import take_prefix
from sb3_fedguide.state.checkpoint_files import newest_checkpoint, remove_leftovers, write_checkpoint

logger = logging.getLogger(__name__)

Answer = tuple[Payload, dict[str, Any]]

#: The client's parameters after the run, in its folder: see :meth:`Federation.export_parameters`.
PARAMETERS = "parameters.npz"
#: In the folder of a deployed client, that of its :class:`Site`.
SITE = "site"


class Site:
    """Answers the server's messages for one client; its whole state is in its folder after each message.

    So a new process can answer every message, and a message that arrives twice is answered from disk. After an exception
    this object is unusable: a new one resumes from disk.

    :param model: an untrained federation of this one client, ``clients=[k]``, with a seed
    :param n_rounds: rounds of the whole run
    :param folder: used only for this client
    :param eval_freq: rounds between evaluations, as in :class:`~sb3_fedguide.common.evaluation.FederatedEvalCallback`;
        ``None`` for none
    :param n_episodes: episodes of an evaluation
    :param report: send the server the round's log and the evaluations' returns; otherwise only uploads leave the client
    :raises ValueError: for a model of several clients, for a report together with noise on uploads, or a folder with the
        state of another client or run
    """

    def __init__(
        self,
        model: Federation,
        n_rounds: int,
        folder: str | Path,
        eval_freq: int | None = EVAL_FREQ,
        n_episodes: int = EVAL_EPISODES,
        report: bool = True,
    ) -> None:
        if model.n_clients != 1:
            raise ValueError(
                f"a site holds one client, but this model holds {model.client_ids}; make it with clients=[k], and a site with "
                "a folder of its own for each of them"
            )
        if not model.is_federated:
            raise ValueError(
                f"{type(model).__name__} has all clients' data in one place and cannot be deployed to their machines"
            )
        if report and model.protects_uploads:
            raise ValueError(
                "noise_multiplier protects what a client uploads, and its report (the round's log, the evaluations' returns) "
                "would go to the server without noise; set report: false"
            )
        self.model, self.n_rounds, self.folder = model, n_rounds, Path(folder)
        self.client_id = model.client_ids[0]
        model.strategy = None  # it is on the server
        model.draw_secret_keys()
        self._log = _LastLog()
        model.set_logger(Logger(None, [self._log]))
        self._report = report
        self._evaluation = None if eval_freq is None or not report else _SiteEvaluation(n_rounds, eval_freq, n_episodes)
        self._learning: tuple[BaseCallback, list[RoundCallback]] | None = None
        self._trunk: TrunkTraining | None = None
        #: the arguments of :meth:`Pretraining.trunk_training`
        self._trunk_arguments: dict[str, Any] = {}
        #: the run of the server that this client takes part in
        self.run: str | None = None
        #: messages that were answered
        self.n_answered = 0
        #: number of the server's last broadcast that arrived here
        self.n_received = 0
        self._reply: Message | None = None
        self._is_usable = True
        self._load()

    @property
    def prepared(self) -> bool:
        """Whether this client has completed the offline stage."""
        return self.model.pretrained

    def facts(self) -> dict[str, Any]:
        """The facts that this client sends when it joins."""
        model = self.model
        sizes = {"observations": model.observation_space, "actions": model.action_space}
        shapes = {**{name: list(space.shape or ()) for name, space in sizes.items()}, **model.upload_shapes()}
        trunk = model.offline_stage().trunk_settings() if model.uses_prior else None
        return {**self._identity(), "client": self.client_id, "shapes": shapes, "trunk": trunk}

    def handle(self, message: Message) -> Message:
        """Execute the server's request, and reply; the reply has the same kind and round.

        An exception stays on this machine: a transport sends :meth:`~sb3_fedguide.deployment.transport.Failure.of` instead.

        :raises ValueError: for a message of another run, or of a server that has gone back in this one
        :raises RuntimeError: after an exception
        """
        if not self._is_usable:
            raise RuntimeError("an error interrupted this client's last message; make a new Site, which resumes from disk")
        if self.run not in (None, message.facts[RUN]):
            raise ValueError(
                f"{self.folder} holds the state of another run of the server; give this client a new folder for a new run"
            )
        reply = self._reply
        if reply is not None and (reply.kind, reply.round) == (message.kind, message.round):
            return reply
        if message.kind == "join":
            return self._join(message)
        if message.kind in ("moments", "trunk") and not self.model.uses_prior:
            raise ValueError(
                f"{type(self.model).__name__} shares nothing before the first round, and the server asks for {message.kind} "
                "of this client's data"
            )
        if message.kind in ("round", "finish") or (message.kind == "setup" and message.round > 0):
            if not self.prepared:
                return Message(message.kind, message.round, facts={UNPREPARED: True})
        if message.kind == "setup" and message.round == 0 and self.prepared:  # the server was killed before it noted that
            return Message("setup", 0)
        self._refuse_older(message)
        self._is_usable = False
        self.run = message.facts[RUN]
        answer = {
            "moments": self._moments, "trunk": self._train_trunk, "setup": self._set_up, "round": self._play_round,
            "finish": self._finish,
        }[message.kind]  # fmt: skip
        payload, facts = answer(message)
        self._reply = Message(message.kind, message.round, payload, facts)
        self.n_answered += 1
        self._save()
        self._is_usable = True
        return self._reply

    def _refuse_older(self, message: Message) -> None:
        """Refuse a server that went back to a state before this client's last message: the client would train twice.

        :raises ValueError: for its message
        """
        last = self._reply
        is_older = last is not None and (KINDS.index(message.kind), message.round) < (KINDS.index(last.kind), last.round)
        if is_older or (message.payload and message.facts.get("broadcast", self.n_received) < self.n_received):
            raise ValueError(
                f"the server has gone back to an older checkpoint: {message.kind} {message.round} is older than what client "
                f"{self.client_id} has answered or received; restore the clients' folders with it, or begin a new run"
            )

    def _join(self, message: Message) -> Message:
        """Nothing is stored: a refused client can join with corrected settings in the same folder."""
        facts = self.facts()
        if other := difference(facts, message.facts, SERVER_FACTS, "the server's"):
            logger.warning("the server will refuse client %d: %s", self.client_id, other)
        return Message("join", message.round, facts=facts)

    def _moments(self, message: Message) -> Answer:
        stage = self.model.offline_stage()
        (data,), (n_updates,) = stage.datasets(), stage.trunk_updates()
        return observation_moments(data.observations), {"n_updates": n_updates}

    def _train_trunk(self, message: Message) -> Answer:
        if self._trunk is None:
            moments = take_prefix(message.payload, MOMENTS)
            self._begin_trunk({"mean": moments["mean"], "std": moments["std"], "n_updates": message.facts["n_updates"]})
        assert self._trunk is not None
        if trunk := take_prefix(message.payload, TRUNK):
            self._trunk.receive(trunk)
        self._trunk.n_done = message.facts["n_done"]  # a client that missed something continues with the others' learning rate
        self._trunk.run(message.facts["average_every"])
        return self._trunk.uploads()[0], {}

    def _begin_trunk(self, arguments: dict[str, Any]) -> None:
        self._trunk_arguments = arguments
        self._trunk = self.model.offline_stage().trunk_training(**arguments)

    def _set_up(self, message: Message) -> Answer:
        if message.round == 0:
            self.model.pretrain(trunk=message.payload or None)
            self._trunk = None
            self._learn()
            return {}, {}
        evaluations = self._receive(message)
        return self.model.outgoing(0), {"evaluations": evaluations}

    def _play_round(self, message: Message) -> Answer:
        callbacks, hooks = self._learn()
        evaluations, model = self._receive(message), self.model
        # Every schedule follows the federation's rounds, also those without this client.
        model.round = message.round - 1
        model.num_timesteps = model.round * model.rollout_size
        with in_round(message.round):
            model.play_round(callbacks, hooks, log_interval=1)
        if self._evaluation is not None and self._evaluation.is_due(message.round):
            evaluations.append(self._evaluated("deployed", message.round))
        payload = model.outgoing(0)
        figures = model.upload_metrics(public=not self._report)
        if self._report:
            figures = {**self._log.metrics, **figures}
        facts: dict[str, Any] = {"figures": figures, "evaluations": evaluations}
        if model.test_steps and not model.protects_uploads:
            facts["test_steps"] = model.test_steps
        return payload, facts

    def _finish(self, message: Message) -> Answer:
        evaluations = self._receive(message)
        self.model.export_parameters(self.folder / PARAMETERS)
        return {}, {"evaluations": evaluations}

    def _receive(self, message: Message) -> list[dict[str, Any]]:
        """Take the server's broadcast, unless it has arrived already; return its evaluation, if one is due."""
        number, after = message.facts["broadcast"], message.facts["after"]
        if not message.payload or number == self.n_received:
            return []
        self._learn()
        self.model.take_broadcasts({0: message.payload})
        self.n_received = number
        due = self._evaluation is not None and broadcast_is_due(after, self.n_rounds, self._evaluation.eval_freq)
        return [self._evaluated("broadcast", after)] if due and after > 0 and self.model.sends_policy(after) else []

    def _evaluated(self, policy: str, round: int) -> dict[str, Any]:
        assert self._evaluation is not None
        evaluation = self._evaluation.last[policy] if policy == "deployed" else self._evaluation.run()
        successes = None if evaluation.successes is None else evaluation.successes[0].tolist()
        returns, lengths = evaluation.returns[0].tolist(), evaluation.lengths[0].tolist()
        return ClientEvaluation(self.client_id, round, policy, returns, lengths, successes).facts()

    def _learn(self) -> tuple[BaseCallback, list[RoundCallback]]:
        """Begin to train, or resume, with the first message that needs it."""
        if self._learning is None:
            model = self.model
            _, callbacks, hooks = model.start_learning(
                self.n_rounds * model.rollout_size - model.num_timesteps,
                [] if self._evaluation is None else [self._evaluation],
                reset_num_timesteps=model._last_obs is None,
            )
            self._learning = callbacks, hooks
        return self._learning

    def _identity(self) -> dict[str, Any]:
        model = self.model
        return {
            "algorithm": algorithm_name(type(model)),
            "version": sb3_fedguide.__version__,
            "seed": model.seed,
            "n_rounds": self.n_rounds,
            "rollout_size": model.rollout_size,
            "settings": model.server_settings(),
        }

    def _save(self) -> None:
        assert self._reply is not None
        trunk = self._trunk and {"arguments": freeze(self._trunk_arguments), "training": self._trunk.save_state()}
        state: State = {
            "identity": freeze(self._identity()),
            "run": self.run,
            "n_received": self.n_received,
            "reply": freeze(vars(self._reply)),
            "trunk": trunk,
            "model": self.model.save_state() if self.prepared else None,
        }
        write_checkpoint(self.folder, self.n_answered, state)

    def _load(self) -> None:
        """Load the state in the folder, if there is one.

        :raises ValueError: if it is another client's or another run's
        """
        remove_leftovers(self.folder)
        found = newest_checkpoint(self.folder)
        if found is None:
            return
        path, state = found
        identity = self._identity()
        if other := difference(thaw(state["identity"]), identity, RUN_FACTS, "here"):
            raise ValueError(f"{path} is of another run: {other}; give this one a folder of its own")
        self.n_answered = int(path.stem.removeprefix("round_"))
        self.run, self.n_received = state["run"], state["n_received"]
        self._reply = Message(**thaw(state["reply"]))
        if state["trunk"] is not None:
            self._begin_trunk(thaw(state["trunk"]["arguments"]))
            assert self._trunk is not None
            self._trunk.load_state(state["trunk"]["training"])
        if state["model"] is not None:
            self.model.load_state(state["model"])


class _SiteEvaluation(FederatedEvalCallback):
    """Evaluates the deployed policy. The broadcast policy comes with the next message; environments are made when needed."""

    def _on_training_start(self) -> None:
        pass

    def _on_round_end(self) -> None:
        pass

    def run(self) -> Evaluation:
        if not hasattr(self, "env"):
            self.env = evaluation_env(self.model, self.n_episodes)
        return super().run()


class _LastLog(KVWriter):
    """Keeps the numbers of the last log that was written."""

    def __init__(self) -> None:
        self.metrics: dict[str, float] = {}

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        numbers = {key: value for key, value in key_values.items() if isinstance(value, (int, float, np.number))}
        self.metrics = {key: float(value) for key, value in numbers.items() if math.isfinite(value)}

    def close(self) -> None:
        pass


def make_site(config: Mapping[str, Any], folder: str | Path) -> Site:
    """The site that a client's own configuration describes.

    :param config: see :class:`sb3_fedguide.deployment.site_config.SiteConfig`
    :param folder: for the client's state
    :raises ValueError: for anything unknown, missing, of the wrong type or out of range
    """
    from sb3_fedguide.deployment.site_config import make_client, read_site_config

    checked = read_site_config(config)
    model, n_rounds = make_client(checked)
    return Site(model, n_rounds, folder, checked.eval_freq or None, checked.eval_episodes, checked.report)
