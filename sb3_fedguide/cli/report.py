"""The summary of a run: ``summary.json`` and a table on the terminal."""

from __future__ import annotations

import statistics
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table

from sb3_fedguide.common.digits import decimals

if TYPE_CHECKING:
    from sb3_fedguide.cli.recorder import CostCallback, RunEvalCallback
    from sb3_fedguide.common.federation import Federation


def summarize(
    model: Federation,
    costs: CostCallback,
    evaluation: RunEvalCallback | None,
    pretraining_seconds: float,
    total_seconds: float,
    **identity: Any,
) -> dict[str, Any]:
    """One run in a page of plain data: clients, length, returns, and communication.

    :param identity: other entries that identify the run, such as its algorithm
    """
    evaluated = evaluation.last if evaluation is not None else {}
    evaluating = evaluation.seconds if evaluation is not None else 0.0
    other = max(0.0, total_seconds - pretraining_seconds - sum(costs.seconds.values()) - evaluating)
    result: dict[str, Any] = {
        **identity,
        "seed": model.seed,
        "n_clients": model.n_clients,
        "clients": model.client_ids,
        "rounds_done": model.round,
        "finished": model.round >= identity["n_rounds"],
        "timesteps": model.environment_steps,
        "test_timesteps": model.test_steps,
        **costs.n_bytes,
        "rejected_uploads": {str(client): number for client, number in sorted(costs.rejected.items())},
        "seconds": {
            "total": total_seconds,
            "pretraining": pretraining_seconds,
            **costs.seconds,
            "evaluation": evaluating,
            "other": other,  # pictures, checkpoints, logs
            "median_round": statistics.median(costs.round_seconds) if costs.round_seconds else None,
        },
    }
    if privacy := model.upload_summary():
        result["privacy"] = privacy
    if model.delays is not None:
        result |= {"delays": str(model.delays.settings), "simulated_seconds": model.delays.seconds}
    for policy in evaluated:
        result[policy] = {
            "client_returns": [float(value) for value in evaluated[policy].client_returns],
            "client_lengths": [float(value) for value in evaluated[policy].lengths.mean(axis=1)],
            "average": evaluated[policy].average,
            "worst_client": evaluated[policy].worst_client,
            "success_rates": evaluated[policy].success_list,
            "n_episodes": int(evaluated[policy].returns.shape[1]),
            "curve": [list(point) for point in evaluation.curves[policy]] if evaluation is not None else [],
            "client_curve": [list(point) for point in evaluation.client_curves[policy]] if evaluation is not None else [],
        }
    return result


def print_summary(summary: dict[str, Any], folder: str) -> None:
    """The table at the end of a run."""
    console = Console(width=None if Console().is_terminal else 100)
    policies = [policy for policy in ("deployed", "broadcast") if policy in summary]
    rounds = f"{summary['rounds_done']} of {summary['n_rounds']} rounds"
    table = Table(title=f"{summary['algo']} on {summary['env']}, seed {summary['seed']}, {rounds}", title_justify="left")
    places = decimals(value for policy in policies for value in summary[policy]["client_returns"])
    table.add_column("client", justify="right")
    for policy in policies:
        table.add_column(f"{policy} return", justify="right")
    table.add_column("episode length", justify="right")
    for index, client in enumerate(summary["clients"] if policies else []):
        values = [f"{summary[policy]['client_returns'][index]:.{places}f}" for policy in policies]
        table.add_row(str(client), *values, f"{summary[policies[0]]['client_lengths'][index]:.0f}")
    if policies:
        table.add_section()
        table.add_row("[bold]average", *[f"[bold]{summary[policy]['average']:.{places}f}" for policy in policies], "")
        table.add_row("worst", *[f"{summary[policy]['worst_client']:.{places}f}" for policy in policies], "")
        console.print(table)
    else:
        console.print(f"{table.title}; no evaluation")
    seconds = summary["seconds"]
    parts = ", ".join(
        f"{part} {seconds[part]:.0f} s" for part in ("pretraining", "rollout", "train", "exchange", "evaluation", "other")
    )
    console.print(f"time   {seconds['total']:.0f} s ({parts})", highlight=False)
    offline = [summary[f"offline_bytes_{way}"] for way in ("up", "down")]
    n_rounds = max(summary["rounds_done"], 1)
    each = [(summary[f"bytes_{way}"] - before) / n_rounds for way, before in zip(("up", "down"), offline, strict=True)]
    once = f"; once, before: {format_size(offline[0])} up, {format_size(offline[1])} down" if any(offline) else ""
    console.print(f"bytes  per round {format_size(each[0])} up, {format_size(each[1])} down{once}", highlight=False)
    if summary["rejected_uploads"]:
        counts = ", ".join(f"client {client} {number}" for client, number in summary["rejected_uploads"].items())
        console.print(f"rejected uploads: {counts}", highlight=False)
    if privacy := summary.get("privacy"):
        console.print(describe_privacy(privacy), highlight=False)
    console.print(f"folder {folder}", highlight=False, soft_wrap=True)


def describe_privacy(privacy: dict[str, Any]) -> str:
    """The privacy spent by a run's uploads, in a line."""
    clipping = f"{privacy['clipped']:.0%} clipped to {privacy['clipping_norm']:g}"
    if "epsilon" not in privacy:
        return f"privacy none: uploads without noise, {clipping}"
    most = max(privacy["uploads"].values())
    return f"privacy epsilon {privacy['epsilon']:.3g} at delta {privacy['delta']:g} after {most} uploads, {clipping}"


def format_size(n_bytes: float) -> str:
    """Bytes in a readable unit."""
    for unit in ("B", "kB", "MB"):
        if n_bytes < 1000:
            return f"{n_bytes:.0f} {unit}" if unit == "B" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.2f} GB"
