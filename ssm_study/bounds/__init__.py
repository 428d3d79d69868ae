"""Proved properties of identified models: ranges of slopes, gains and reachability. They also
include Lipschitz constants, Hankel singular values and balancing."""
