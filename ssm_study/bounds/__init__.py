"""Proved properties of identified models: slopes, gains and reachability. Properties of a model
that can be proved: slopes, Lipschitz constants, Gramians, Hankel singular values, balancing."""
