"""An algorithm of one's own in one module: clients move half of the way to the average."""

from __future__ import annotations

from sb3_fedguide import FedAvg, register_algorithm


class HalfAveraging(FedAvg):
    """FedAvg whose clients keep half of their own parameters."""

    def receive(self, index, broadcast):
        own = self.policy.client_state_dict(index)
        self.policy.load_client(index, {name: 0.5 * own[name].numpy() + 0.5 * array for name, array in broadcast.items()})


register_algorithm("half-averaging", f"{__name__}:HalfAveraging")
