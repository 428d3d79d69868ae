"""Controllers that ours is compared with."""
