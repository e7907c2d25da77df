"""What a run shows of itself: the paper's diagnostics, TensorBoard's charts and hyperparameters, pictures."""
