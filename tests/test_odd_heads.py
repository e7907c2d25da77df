"""What the server says of prior heads that look wrong although they pass its checks."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from sb3_fedguide import FedGuide
from sb3_fedguide.common.callbacks import RoundCallback
from sb3_fedguide.server.ot_moe import HEAD, OTMoE, head_oddity, head_shares


def exchanged(heads: np.ndarray) -> OTMoE:
    """The server after an exchange of these heads, ``(n_clients, ...)``."""
    server = OTMoE(4, cost="param")
    server.exchange(0, {client: {HEAD: head} for client, head in enumerate(heads)})
    return server


#: Heads of eight honest clients in two rounds of one run, ``(rounds, clients, action_dim, p + 1)``, by family.
HONEST_HEADS = dict(np.load(Path(__file__).parent / "data" / "heads.npz"))
LIES = {"negated": lambda head: -head, "random": lambda head: np.random.default_rng(0).standard_normal(head.shape)}


@pytest.mark.parametrize("family", HONEST_HEADS)
def test_a_wrong_head_that_passes_the_check_of_norms_is_doubted_and_honest_ones_are_not(family):
    for heads in HONEST_HEADS[family]:
        honest = exchanged(heads)
        assert not honest.doubts and not honest.rejected
        for name, lie in LIES.items():
            if name == "random" and family == "Bandit2D":
                continue  # six numbers: they may happen to agree
            wrong = heads.copy()
            wrong[5] = lie(heads[5])
            server = exchanged(wrong)
            assert [*server.doubts] == [5] and not server.rejected
            share = server.client_metrics["head_share"][5]
            assert f"; the others' priors take {share:.1%} from it (an even share is 12.5%)" in server.doubts[5]


def test_what_is_said_of_heads_against_its_definition():
    heads = np.array([[[2.0, 0.0]], [[3.0, 4.0]], [[0.0, -1.0]]], dtype=np.float32)  # their median is (2, 0)
    agreement, distance = head_oddity(heads)
    np.testing.assert_allclose(agreement, [1.0, 0.6, 0.0], atol=1e-12)
    np.testing.assert_allclose(distance, [0.0, 17**0.5, 5**0.5])
    assert head_oddity(np.zeros((3, 1, 2), dtype=np.float32))[0].tolist() == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(head_shares(np.full((4, 3), 1 / 12)), 0.25)
    np.testing.assert_allclose(head_shares(np.eye(3) / 3), 0.0, atol=1e-12)
    # clients 0 and 1 share an expert evenly, client 2 has its own: 0 and 1 hold half of each other, nobody holds 2
    np.testing.assert_allclose(head_shares(np.array([[1, 0], [1, 0], [0, 1]]) / 3), [0.25, 0.25, 0.0], atol=1e-12)


def test_two_heads_are_too_few_to_doubt_one():
    server = exchanged(np.stack([HONEST_HEADS["Bandit2D"][0][0], -HONEST_HEADS["Bandit2D"][0][0]]))
    assert not server.doubts and not server.client_metrics


def test_a_doubtful_client_is_named_once_and_logged_every_round(small):
    offline = {"dataset_size": 60, "bc_updates": 2, "dice_updates": 2, "dice_width": 8, "dice_batch_size": 16}
    model = FedGuide("MlpPolicy", env="Bandit2D", eta=1.0, pretraining=offline, **small)
    upload = model.upload
    model.upload = lambda index: {**upload(index), **({HEAD: -model.heads[2]} if index == 2 else {})}
    logged = []

    class Watch(RoundCallback):
        def _on_round_end(self) -> None:
            logged.append(self.logger.name_to_value["client_2/head_agreement"])

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(3 * model.rollout_size * model.n_clients, Watch())
    told = [str(warning.message) for warning in caught if "looks wrong" in str(warning.message)]
    assert len(told) == 1 and told[0].startswith("round 0: the upload of client 2 is used, but looks wrong: the cosine of")
    assert len(logged) == 3 and max(logged) < 0
