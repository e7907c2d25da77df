"""What clients report to a server, what they send of the trunk, and what the server does not need."""

from __future__ import annotations

import logging
import re
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fed_envs.faults import ClientError
from sb3_fedguide.deployment.transport import Message
from sb3_fedguide.server.metrics import ClientEvaluation, evaluation_metrics, merge_metrics, read_evaluations
from sb3_fedguide.server.trunk import TrunkAverages, excessive_updates, moments_fault
from tests.loop_transport import NAME, Client, LoopTransport, run

ROOT = Path(__file__).resolve().parent.parent


# --- what clients report --------------------------------------------------------------------------------------------------


def test_reports_are_data_of_strangers():
    assert merge_metrics(
        {0: {"figures": "none"}, 1: {}, 2: {"figures": {1: 2, "a": "b", "c": True, "d": 3, "eval/x": 1}}}
    ) == {"d": 3}
    hostile = {"a": 10**400, "b": float("nan"), "c": float("-inf"), "client_1/d": 10**400, "client_1/e": float("nan"), "f": 2}
    assert merge_metrics({0: {"figures": {"a": 1, "b": 2.0}}, 1: {"figures": hostile}}) == {"a": 1.0, "b": 2.0, "f": 2.0}
    good = ClientEvaluation(4, 2, "broadcast", [1.0, 2.0], [3, 4], [True, False])
    assert read_evaluations(4, {"evaluations": [good.facts()]}) == [good]
    for change in (
        {"returns": [float("nan"), 1.0]}, {"returns": []}, {"lengths": [1]}, {"policy": "../x"}, {"round": "x"},
        {"successes": [True]}, {"returns": None}, {"returns": [10**400, 1.0]}, {"lengths": [10**400, 1]},
        {"lengths": [2**53, 1]}, {"lengths": [-1, 1]},
    ):  # fmt: skip
        assert read_evaluations(4, {"evaluations": [{**good.facts(), **change}]}) == []
    assert read_evaluations(4, {"evaluations": "x"}) == read_evaluations(4, {"evaluations": [3, None]}) == []
    figures = evaluation_metrics([good, ClientEvaluation(1, 2, "deployed", [4.0], [2], [True])])
    assert figures["eval/broadcast_mean_reward"] == 1.5 and figures["eval/success_rate"] == 1.0


# --- the trunk ------------------------------------------------------------------------------------------------------------


def moments(**changes: Any) -> dict[str, Any]:
    return {"n_samples": np.array(5.0), "mean": np.zeros(2), "var": np.ones(2), **changes}


@pytest.mark.parametrize(
    "changes",
    [
        {"n_samples": np.array(0.0)}, {"n_samples": np.array(1.5)}, {"n_samples": np.array(np.inf)}, {"n_samples": 5.0},
        {"mean": np.zeros(2, np.float32)}, {"mean": np.array([np.nan, 0])}, {"var": -np.ones(2)}, {"var": np.ones(3)},
        {"mean": np.zeros((2, 1)), "var": np.ones((2, 1))}, {"mean": np.zeros(3), "var": np.ones(3)},
        {"more": np.zeros(1)}, {"mean": "x"},
        {"mean": np.array([0, -2e12])}, {"var": np.array([2e12, 0])}, {"n_samples": np.array(2.0**41)},
    ],
)  # fmt: skip
def test_moments_that_cannot_be_are_found(changes):
    assert moments_fault(moments(), [2]) is None
    assert moments_fault(moments(**changes), [2]) is not None


@pytest.mark.parametrize("n_updates", [701, 10**9, 10**400, True, "7"])
def test_one_client_does_not_have_all_train_for_ever(n_updates, caplog):
    common = {"shapes": {NAME: [3], "observations": [2]}, "trunk": {"prior_average_every": 4}}

    class Trunk(Client):
        def answer(self, message: Message):
            if message.kind == "moments":
                return moments(), {"n_updates": n_updates if self.client == 0 else 7}
            if message.kind == "trunk":
                return {"w": np.ones(2, np.float32)}, {}
            return super().answer(message)

    with caplog.at_level(logging.WARNING):
        _, server, _ = run(transport=LoopTransport(lambda client: Trunk(client, **common), [0, 1, 2, 3]))
    assert server.trunk.clients == [1, 2, 3] and server.trunk.n_updates == 7 and server.round == 5
    assert re.search(r"moments of client 0: it wants \d+ updates|client 0 is left out \(its answer is of no use", caplog.text)
    assert excessive_updates({0: 700, 1: 7, 2: 7}) == {} and list(excessive_updates({0: 701, 1: 7, 2: 7})) == [0]


def test_trunks_are_averaged_by_samples_and_broken_ones_are_left_out():
    own = {0: moments(), 1: moments(n_samples=np.array(15.0)), 2: moments()}
    trunk = TrunkAverages(own, n_updates=5, average_every=2, upload_bound=30.0)
    assert trunk.facts() == {"n_updates": 5, "n_done": 0, "average_every": 2}
    assert sorted(trunk.payload()) == [
        "moments.mean",
        "moments.std",
    ]
    values = {client: {"w": np.full(2, float(client), np.float32)} for client in own}
    assert trunk.average({0: values[0], 1: values[1]}) == {}
    np.testing.assert_allclose(trunk.trunk["w"], [0.75, 0.75])
    rejected = trunk.average({**values, 2: {"w": np.full(2, np.nan, np.float32)}})
    assert list(rejected) == [2] and trunk.n_done == 4 and not trunk.finished
    again = TrunkAverages.from_state(trunk.save_state())
    assert again.facts() == trunk.facts()
    with pytest.raises(ClientError, match="rejects every upload: client 2"):
        again.average({2: {"w": np.full(2, np.nan, np.float32)}})
    assert again.n_done == 4
    again.average({0: values[0]})
    assert again.n_done == 5 and again.finished and not trunk.finished


# --- without PyTorch ------------------------------------------------------------------------------------------------------

ALONE = """
import importlib.machinery
import sys

blocked = ["torch", "gymnasium", "mujoco", "metaworld", "stable_baselines3", "gymnasium_robotics", "minari", "pydantic"]

class Finder(importlib.machinery.PathFinder):  # as if they were not installed
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in blocked else super().find_spec(name, path, target)

sys.meta_path[:] = [Finder if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path]
from sb3_fedguide.registry import ALGORITHMS
from sb3_fedguide.server.methods import complete_settings, make_strategy
for name in ALGORITHMS:
    make_strategy(name, {}, 3, 0)
import numpy as np
import sb3_fedguide
from sb3_fedguide.deployment.serve import ServerConfig, serve
from sb3_fedguide.deployment.transport import Message

class Transport:
    def clients(self):
        return [0, 1, 2]

    def send_and_receive(self, requests, timeout):
        return {client: self.reply(client, request) for client, request in requests.items()}

    def reply(self, client, request):
        facts, payload = {}, {}
        if request.kind == "join":
            facts = {
                "algorithm": "fedguide-a", "version": sb3_fedguide.__version__, "seed": 0, "n_rounds": 4, "rollout_size": 8,
                "settings": complete_settings("fedguide-a", {"average_every": 2}), "client": client,
                "shapes": {"observations": [2]}, "trunk": {"prior_average_every": 3},
            }
        rng = np.random.default_rng(client)
        if request.kind == "moments":
            payload, facts = {"n_samples": np.array(9.0), "mean": rng.normal(size=2), "var": np.ones(2)}, {"n_updates": 7}
        if request.kind == "trunk":
            payload = {"w": rng.normal(size=(2, 2)).astype(np.float32)}
        if request.kind == "round" or (request.kind == "setup" and request.round > 0):
            payload["prior.head"] = rng.normal(size=(2, 3)).astype(np.float32)
            if "prior.experts" in request.payload or request.kind == "round":
                payload["prior.cost_row"] = rng.random(3).astype(np.float32)
        if request.kind == "round" and request.round % 2 == 0:
            payload.update(log_std=np.zeros(2, np.float32), n_samples=np.array(8, np.float32))
        return Message(request.kind, request.round, payload, facts)

config = ServerConfig("fedguide-a", 3, 4, 8, 0, {"average_every": 2}, wait=0.0, poll=0.0)
for n in (1, 2):
    server = serve(config, Transport(), sys.argv[1])
print(server.round, server.trunk.n_done, sorted(sys.modules.keys() & set(blocked)))
"""


def test_the_server_needs_neither_pytorch_nor_environments(tmp_path):
    command = [sys.executable, "-c", textwrap.dedent(ALONE), str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert result.stdout == "4 7 []\n", result.stderr
