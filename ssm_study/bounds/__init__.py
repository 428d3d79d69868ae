"""What is provable of a model: slopes, Lipschitz constants, Gramians, Hankel singular values,
balancing."""
