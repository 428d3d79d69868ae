"""Training of models from data. Lightning lives here and nowhere else."""
