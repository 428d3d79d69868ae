"""Controllers with which ours is compared."""
