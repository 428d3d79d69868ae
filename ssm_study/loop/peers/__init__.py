"""Standard control methods with which the project's own is compared."""
