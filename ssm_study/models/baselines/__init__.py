"""Models that ours is compared with."""
