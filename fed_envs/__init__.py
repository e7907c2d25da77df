"""Heterogeneous client environments for federated reinforcement learning."""
