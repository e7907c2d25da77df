"""Federated reinforcement learning for Stable-Baselines3."""
