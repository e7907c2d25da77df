"""Simulated time: who is heard when, by hand, and that a federation without delays is what it was."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sb3_fedguide.server.delays import Delays, DelaySettings, delay_settings, parse_delays
from tests.scripted_delays import NEVER, Scripted


def play(delays: Delays, rounds: int, client_fraction: float = 1.0) -> list[tuple[list[int], list[int], float]]:
    """Who begins, who is heard, and the second at which each round ends."""
    found = []
    for round in range(rounds):
        present, arrived = delays.begin(round, client_fraction), delays.end()
        found.append((np.flatnonzero(present).tolist(), np.flatnonzero(arrived).tolist(), delays.seconds))
    return found


# --- the three policies, by hand ------------------------------------------------------------------------------------------


def test_sync_waits_for_the_slowest_and_for_the_timeout_of_who_drops_out():
    delays = Scripted(DelaySettings("sync", timeout=50), [[10, 10, 10], [40, 20, 90], [5, NEVER, NEVER]])
    assert play(delays, 3) == [([0, 1, 2], [0, 1, 2], 40), ([0, 1, 2], [0, 1], 90), ([0, 1, 2], [0, 1], 180)]
    assert not delays.keep_busy and not delays.training.any()


def test_a_deadline_ends_the_round_and_the_late_are_busy_until_they_have_finished():
    delays = Scripted(DelaySettings("deadline", deadline=30, timeout=20), [[10, 10, 10], [40, 5, 5], [5, NEVER, 30]])
    assert play(delays, 3) == [
        ([0, 1, 2], [0, 2], 30),  # client 1 needs until 40
        ([0, 2], [0], 50),  # everybody else has come or is known not to: no need to wait until 60
        ([0, 1, 2], [0, 1, 2], 80),  # just in time
    ]


def test_after_a_deadline_that_nobody_meets_the_next_round_waits_for_the_first():
    delays = Scripted(DelaySettings("deadline", deadline=30), [[50, 10], [45, 10]])
    assert play(delays, 2) == [([0, 1], [], 45), ([1], [1], 55)]
    assert delays.finished.tolist() == [True, True]  # client 0 as well, in second 50


def test_async_aggregates_in_every_tick_what_has_come():
    delays = Scripted(DelaySettings("async", tick=10), [[5, 12, 5, 5], [25, 8, 8, 8], [10, 30, 9, 9]])
    assert play(delays, 4) == [
        ([0, 1, 2], [0, 2], 10),
        ([0, 2], [0, 1], 30),  # nobody was idle at 20
        ([0, 1], [0, 1, 2], 40),
        ([0, 1, 2], [0, 1, 2], 50),
    ]


def test_staleness_counts_the_rounds_since_a_client_began():
    delays = Scripted(DelaySettings("async", tick=10), [[5, 5, 5, 5], [25, 8], [10, NEVER, 9]])
    staleness = []
    for round in range(3):
        delays.begin(round)
        delays.end()
        staleness.append(delays.metrics["federated/staleness"])
    # Client 1 began in round 0 and is heard in round 2, with client 0 who began in it.
    assert staleness == [0, 0, 1.0] and delays.metrics == {
        "federated/simulated_seconds": 30, "federated/arrived": 2, "federated/staleness": 1.0
    }  # fmt: skip


def test_ticks_in_which_nobody_is_idle_are_no_rounds():
    delays = Scripted(DelaySettings("async", tick=7, median=7), [[100, 20, 1], [NEVER, 30, 30]])
    delays.idle_at[1], delays.training[1] = 1000.0, False
    assert play(delays, 2) == [([0], [0], 105), ([0], [0], 126)]


def test_who_dropped_out_begins_again_after_the_timeout():
    delays = Scripted(DelaySettings("async", tick=10, timeout=15), [[5, 5, 5, 5], [NEVER, 4, 4, 4]])
    assert play(delays, 4) == [([0, 1], [0], 10), ([0], [0], 20), ([0, 1], [0, 1], 30), ([0, 1], [0, 1], 40)]


# --- identities -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dropout", [0.0, 0.3])
def test_an_infinite_deadline_is_sync(dropout):
    histories = [
        play(Delays(DelaySettings(policy, spread=0.8, dropout=dropout, **more), 5, range(6)), 12, 0.5)
        for policy, more in [("sync", {}), ("deadline", {"deadline": math.inf})]
    ]
    assert histories[0] == histories[1] and (any(begun != heard for begun, heard, _ in histories[0]) == (dropout > 0))


@pytest.mark.parametrize("settings", ["sync:dropout=0.2", "deadline:deadline=50,dropout=0.2", "async:tick=20,dropout=0.2"])
def test_same_seed_same_history_and_no_other(settings):
    histories = [play(Delays(parse_delays(settings), seed, range(8)), 20) for seed in (1, 1, 2)]
    assert histories[0] == histories[1] != histories[2]


def test_a_clients_rounds_take_the_same_time_under_every_policy_and_in_any_company():
    def draws(delays: Delays, index: int) -> list[tuple[float, bool]]:
        found = []
        for k in range(5):
            delays.begun[index] = k
            found.append(delays.draw(index))
        return found

    alone, together = Delays(DelaySettings("sync"), 3, [7]), Delays(DelaySettings("async"), 3, [2, 7, 9])
    assert draws(alone, 0) == draws(together, 1) != draws(together, 0)


def test_the_distribution_is_the_documented_one():
    settings = DelaySettings("sync", median=100, spread=0.6, jitter=0.3, dropout=0.2)
    delays = Delays(settings, 0, range(600))
    logs, dropped = np.zeros((600, 4)), np.zeros((600, 4))
    for index in range(600):
        for k in range(4):
            delays.begun[index] = k
            seconds, dropped[index, k] = delays.draw(index)
            logs[index, k] = math.log(seconds / 100)
    assert abs(logs.mean()) < 0.08 and abs(logs.mean(axis=1).std() - math.hypot(0.6, 0.15)) < 0.05
    assert abs(np.sqrt(logs.var(axis=1, ddof=1).mean()) - 0.3) < 0.02 and abs(dropped.mean() - 0.2) < 0.03


@pytest.mark.parametrize("settings", ["deadline:deadline=40,dropout=0.2", "async:tick=15,dropout=0.2"])
def test_the_clock_goes_on_from_its_state(settings):
    whole, lost = (Delays(parse_delays(settings), 4, range(6)) for _ in range(2))
    expected = play(whole, 9)
    play(lost, 5)
    resumed = Delays(parse_delays(settings), 99, range(6))  # the seed is part of the state
    resumed.load_state(lost.save_state())
    assert [resumed.training.any(), resumed.seconds] == [True, expected[4][2]]
    resumed_history = []
    for round in range(5, 9):
        present, arrived = resumed.begin(round), resumed.end()
        resumed_history.append((np.flatnonzero(present).tolist(), np.flatnonzero(arrived).tolist(), resumed.seconds))
    assert resumed_history == expected[5:]
    with pytest.raises(ValueError, match="the run has the delays"):
        Delays(parse_delays("sync"), 4, range(6)).load_state(lost.save_state())


def test_somebody_can_always_begin():
    for settings in ("deadline:deadline=1,spread=2", "async:tick=1,spread=2,dropout=0.9,median=60", "sync:dropout=0.99"):
        delays = Delays(parse_delays(settings), 0, range(4))
        before = 0.0
        for begun, _, seconds in play(delays, 60, 0.25):
            assert begun and seconds > before
            before = seconds


# --- settings -------------------------------------------------------------------------------------------------------------


def test_settings_come_back_from_their_text():
    for settings in (
        DelaySettings("sync"),
        DelaySettings("deadline", deadline=math.inf, dropout=0.25),
        DelaySettings("async", median=1 / 3, spread=0.8, tick=0.1, timeout=5),
    ):
        assert parse_delays(str(settings)) == settings
    assert parse_delays("async:median=10") == DelaySettings("async", median=10, tick=10, timeout=20)
    assert delay_settings({"policy": "deadline", "median": 10}) == DelaySettings("deadline", median=10, deadline=20)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "sync or deadline or async, not ''"),
        ("fast", "not 'fast'"),
        ("sync:media=3", "delays have no 'media'"),
        ("sync:median", "'median' is not NAME=NUMBER"),
        ("sync:median=", "median='' is not a number"),
        ("sync:median=nan", "median=nan is not a number"),
        ("sync:median=inf", "must lie in"),
        ("sync:median=3,median=4", "median is given twice"),
        ("sync:policy=3", "policy is given twice"),
        ("sync:spread=-1", "spread=-1.0 must lie in"),
        ("sync:dropout=1", "dropout=1.0 must lie in"),
        ("sync:timeout=inf", "must be positive and finite"),
        ("sync:tick=3", "tick belongs to async"),
        ("async:deadline=3", "deadline belongs to deadline"),
        ("deadline:deadline=0", "deadline=0.0 must be positive"),
        ("async:tick=0.001", "at least a thousandth of the median"),
        ("async:,", "'' is not NAME=NUMBER"),
    ],
)
def test_wrong_settings_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_delays(text)


@pytest.mark.parametrize(
    "values",
    [{"median": 3}, {"policy": ["sync"]}, {"policy": "sync", "median": "3"}, {"policy": "sync", "median": True}],
)
def test_wrong_mappings_are_refused(values):
    with pytest.raises(ValueError):
        delay_settings(values)
