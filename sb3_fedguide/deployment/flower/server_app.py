"""Flower's ServerApp: the round loop over Flower's Grid."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Mapping
from pathlib import Path

from flwr.app import Context
from flwr.serverapp import Grid, ServerApp
from tensorboard.summary import Writer

from sb3_fedguide.deployment.config import ServerConfig
from sb3_fedguide.deployment.flower.certificates import read_public_key
from sb3_fedguide.deployment.flower.transport import FlowerTransport
from sb3_fedguide.deployment.serve import TooFewClients, serve
from sb3_fedguide.exit_codes import EXIT_FAILED, EXIT_USAGE

#: Environment variable with the path of the server's configuration. Flower's own run configuration would go to the clients.
CONFIG = "FEDGUIDE_SERVER_CONFIG"
#: In the server's folder once the federation is over. Flower's process ends with code 0 also if it never started this app.
FINISHED = "finished"

logger = logging.getLogger(__name__)
app = ServerApp()


@app.main()
def main(grid: Grid, context: Context) -> None:
    """Run the federation's rounds to the end.

    :raises SystemExit: with code 2 if the configuration or the folder is wrong, 1 if there were too few clients
    """
    set_up_journal()
    settings = json.loads(Path(os.environ[CONFIG]).read_text(encoding="utf-8"))
    clients = {read_public_key(text): int(client) for client, text in settings["clients"].items()}
    log = RoundLog(Path(settings["folder"]) / "tb")
    try:
        serve(ServerConfig(**settings["server"]), FlowerTransport(grid, clients), settings["folder"], log)
        (Path(settings["folder"]) / FINISHED).touch()
    except TooFewClients as error:
        logger.error("%s; the next start goes on from the last checkpoint", error)
        sys.exit(EXIT_FAILED)
    except ValueError as error:
        logger.error("%s", error)
        sys.exit(EXIT_USAGE)
    finally:
        log.close()


def set_up_journal() -> None:
    """Log lines of this package with their time, and only warnings and errors of other packages."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", force=True)
    logging.getLogger("sb3_fedguide").setLevel(logging.INFO)
    logging.getLogger("flwr").propagate = False  # it writes to the terminal itself


class RoundLog:
    """Writes every round's figures for TensorBoard, and a line for the journal.

    :param folder: of the events
    """

    def __init__(self, folder: Path) -> None:
        self._writer = Writer(str(folder))

    def __call__(self, round: int, figures: Mapping[str, float]) -> None:
        step = int(figures.get("time/total_timesteps", round))
        for key, value in figures.items():
            self._writer.add_scalar(key, value, step=step)
        self._writer.flush()
        shown = {
            "clients": "federated/participants", "failed": "federated/failed", "rejected": "federated/rejected",
            "reward": "rollout/ep_rew_mean", "evaluation": "eval/mean_reward", "seconds": "time/server_round",
        }  # fmt: skip
        values = [f"{name} {figures[key]:.4g}" for name, key in shown.items() if key in figures]
        if values:  # after the last round, clients report their evaluations of its broadcast
            logger.info("round %d: %s", round, ", ".join(values))

    def close(self) -> None:
        self._writer.close()
