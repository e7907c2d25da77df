"""Monitoring of a run: the paper's diagnostics, TensorBoard's charts and hyperparameters, pictures."""
