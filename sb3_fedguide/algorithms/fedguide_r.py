"""FedGuide-R: what measured best here, and falls back to every client's own where sharing hurts."""

from __future__ import annotations

from sb3_fedguide.algorithms.fedavg import FedAvg
from sb3_fedguide.settings.arguments import FedGuideRArguments
from sb3_fedguide.settings.signatures import takes


class FedGuideR(FedAvg):
    """FedAvg that routes every client by its own returns: to what all share while that pays, then to a policy of its own.

    Four parts, each an option of :class:`FedAvg` and here switched on: observation statistics of all clients
    (``normalize="shared"`` in the settings of ``zoo_configs``); a server that goes twice as far as the average
    (``server_step``); a share of it that a client takes, all at first and nothing after two fifths of the run (``mix``, in the
    same settings); and tests in the client's own environments, after which it leaves what the others share, or comes back
    (``screening``).

    It is not of the FedGuide paper, and has neither its priors nor its DICE values: they did not pay (``docs/results.md``).
    What it keeps is the paper's idea that the server's knowledge guides a client only as far as it fits.

    Parameters are those of :class:`FedAvg`, with other defaults.
    """

    @takes(FedGuideRArguments)
    def __init__(self, given: FedGuideRArguments) -> None:
        super().__init__(**vars(given))
