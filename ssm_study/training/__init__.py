"""Training: how a model is fitted to data. Lightning lives
here and nowhere else."""
