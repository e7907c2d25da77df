"""Ray actors on two nodes, and what happens when one of them is killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from sb3_fedguide import FedAvg, Local
from tests.comparisons import assert_same_training
from tests.environments import CountingEnv

pytestmark = pytest.mark.ray
CLIENTS = [lambda target=target: CountingEnv(target) for target in (-0.3, 0.0, 0.3)]


@pytest.fixture(scope="module")
def cluster():
    """A head node for the driver without room for actors, and two nodes of one CPU each."""
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    nodes = [made.add_node(num_cpus=2) for _ in range(2)]
    made.wait_for_nodes()
    yield made, nodes
    ray.shutdown()
    made.shutdown()


def actor_facts(engine):
    """Process and node of each actor."""
    import ray

    def facts(worker):
        return os.getpid(), ray.get_runtime_context().get_node_id()

    return ray.get([actor.__ray_call__.remote(facts) for actor in engine._actors])


def wait_for_end(pid: int) -> None:
    """An actor outlives its node by a moment."""
    until = time.monotonic() + 60
    while Path(f"/proc/{pid}").exists() and time.monotonic() < until:
        time.sleep(0.1)
    assert not Path(f"/proc/{pid}").exists()


def test_actors_on_two_nodes_and_their_loss(cluster, small):
    from sb3_fedguide.engines.ray_actors import RayActors

    made, nodes = cluster
    plain, model = (FedAvg("MlpPolicy", CLIENTS, **small) for _ in range(2))
    per_round = 3 * small["rollout_size"]
    plain.learn(3 * per_round)
    with RayActors(2, made.address) as engine:
        engine.attach(model)

        def learn(rounds):
            model.learn(rounds * per_round, reset_num_timesteps=model.round == 0)

        learn(1)
        before = actor_facts(engine)
        assert len({node for _, node in before}) == 2  # spread over both
        os.kill(before[0][0], signal.SIGKILL)
        learn(1)
        after = actor_facts(engine)
        assert after[0][0] != before[0][0]
        lost = next(node for node in nodes if node.node_id == after[1][1])
        made.remove_node(lost, allow_graceful=False)
        wait_for_end(after[1][0])
        learn(1)
        assert lost.node_id not in {node for _, node in actor_facts(engine)}
    assert_same_training(plain, model)


def test_a_cluster_that_is_not_there_is_refused_at_once(small):
    from sb3_fedguide.engines.ray_actors import RayActors

    model = Local("MlpPolicy", CLIENTS, **small)
    with RayActors(2, "127.0.0.1:9") as engine, pytest.raises(ValueError, match=r"no Ray cluster at 127\.0\.0\.1:9"):
        engine.attach(model)


def test_more_actors_than_cpus_are_refused(cluster, small):
    from sb3_fedguide.engines.ray_actors import RayActors

    model = Local("MlpPolicy", CLIENTS * 3, **small)
    with RayActors(9, cluster[0].address) as engine, pytest.raises(ValueError, match="each of 9 actors takes one"):
        engine.attach(model)


def test_an_error_of_the_worker_is_an_error_here(cluster, small):
    from sb3_fedguide.engines.ray_actors import RayActors

    model = Local("MlpPolicy", CLIENTS, **small)
    with RayActors(2, cluster[0].address) as engine:
        engine.attach(model)
        engine.groups = [[0], [1, 2]]  # not those of the workers
        with pytest.raises(ValueError, match="the state does not fit: its clients"):
            model.learn(1)
