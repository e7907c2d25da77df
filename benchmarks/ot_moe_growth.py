"""Seconds and memory of the OT-MoE server alone, by numbers of clients and experts.

    python benchmarks/ot_moe_growth.py --clients 8 100 1000 10000 --experts 8 64

Clients' heads scatter about as many centres as there are experts and drift from round to round. A round is one
``OTMoE.aggregate``: the costs (for ``param``; with ``score`` the clients send their rows), the transport plan and the new
experts. Memory is the peak of what Python and NumPy allocate in a round, beside the uploads themselves. Writes
``benchmarks/results/ot_moe_growth.json``.
"""

from __future__ import annotations

import argparse
import itertools
import time
import tracemalloc
from typing import Any

import numpy as np
from record import spread, write_result

from sb3_fedguide.server.ot_moe import COST_ROW, EXPERTS, HEAD, MIXTURE_ROW, OTMoE, head_costs, sinkhorn_plan
from sb3_fedguide.server.strategy import Payload


def uploads_of(heads: np.ndarray, experts: np.ndarray | None) -> dict[int, Payload]:
    """What the clients send: heads, and their cost rows once they have experts (squared distances stand in for them)."""
    uploads: dict[int, Payload] = {client: {HEAD: head} for client, head in enumerate(heads)}
    if experts is not None:
        for client, row in enumerate(head_costs(heads, experts).astype(np.float32)):
            uploads[client][COST_ROW] = row
    return uploads


def measure(n_clients: int, n_experts: int, head_shape: tuple[int, int], cost: Any, n_rounds: int) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(n_experts, *head_shape))
    heads = centres[rng.integers(n_experts, size=n_clients)] + 0.5 * rng.normal(size=(n_clients, *head_shape))
    server, experts = OTMoE(n_experts, cost=cost), None

    def next_uploads() -> dict[int, Payload]:
        heads[:] += 0.05 * rng.normal(size=heads.shape)
        return uploads_of(heads.astype(np.float32), experts if cost == "score" else None)

    setup = 0.0
    while server.needs_setup:
        uploads, started = next_uploads(), time.perf_counter()
        experts = server.aggregate(0, uploads)[0][EXPERTS]
        setup += time.perf_counter() - started
    wall, cpu = [], []
    for number in range(1, n_rounds + 1):
        uploads, started, used = next_uploads(), time.perf_counter(), time.process_time()
        experts = server.aggregate(number, uploads)[0][EXPERTS]
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - used)
    uploads = next_uploads()
    tracemalloc.start()
    broadcast = server.aggregate(n_rounds + 1, uploads)[0]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {
        "n_clients": n_clients,
        "n_experts": n_experts,
        "cost": cost,
        "setup_seconds": setup,
        "seconds": spread(wall),
        "cpu_seconds": spread(cpu),
        "peak_bytes": peak,
        "uploaded_bytes": n_clients * sum(array.nbytes for array in uploads[0].values()),
        "sent_bytes_per_client": broadcast[EXPERTS].nbytes + broadcast[MIXTURE_ROW].nbytes,
        "effective_experts": server.metrics["effective_experts"],
        "marginal_error": server.metrics["marginal_error"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, nargs="+", default=[8, 100, 1000, 10_000])
    parser.add_argument("--experts", type=int, nargs="+", default=[8, 64])
    parser.add_argument("--costs", nargs="+", choices=("score", "param"), default=["score", "param"])
    parser.add_argument("--head", type=int, nargs=2, default=[3, 65], help="shape of a head, d and p + 1; that of HopperHard")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()

    sinkhorn_plan(np.ones((2, 2)), 1.0)  # importing POT takes a second
    cases = []
    print("clients experts cost   seconds (setup)   CPU  peak MB  uploads MB")
    for n_clients, n_experts, cost in itertools.product(args.clients, args.experts, args.costs):
        case = measure(n_clients, n_experts, tuple(args.head), cost, args.rounds)
        cases.append(case)
        print(
            f"{n_clients:7} {n_experts:7} {cost:5} {case['seconds']['median']:8.4f} ({case['setup_seconds']:.4f}) "
            f"{case['cpu_seconds']['median']:7.4f} {case['peak_bytes'] / 1e6:8.1f} {case['uploaded_bytes'] / 1e6:8.1f}",
            flush=True,
        )
    path = write_result("ot_moe_growth", {"command": vars(args), "cases": cases})
    print(f"written to {path}")


if __name__ == "__main__":
    main()
