"""FedGuide-R: the method with the best results here; a client that sharing harms falls back to its own policy."""

from __future__ import annotations

from sb3_fedguide.algorithms.fedavg import FedAvg
from sb3_fedguide.settings.arguments import FedGuideRArguments
from sb3_fedguide.settings.signatures import takes


class FedGuideR(FedAvg):
    """FedAvg that routes every client by its own returns: to the average while it helps, then to the client's own policy.

    It switches on four options of :class:`FedAvg`: observation statistics of all clients (``normalize="shared"`` in the
    settings of ``zoo_configs``); a server step of twice the average update (``server_step``); the share of the broadcast that
    a client takes, all at first and nothing after two fifths of the run (``mix``, in the same settings); and tests in the
    client's own environments, after which the client leaves the average, or comes back (``screening``).

    It is not in the FedGuide paper, and has neither its priors nor its DICE values: they did not help (``docs/results.md``).
    It keeps the paper's idea that the server's knowledge guides a client only if it fits the client.

    Parameters are those of :class:`FedAvg`, with other defaults.
    """

    @takes(FedGuideRArguments)
    def __init__(self, given: FedGuideRArguments) -> None:
        super().__init__(**vars(given))
