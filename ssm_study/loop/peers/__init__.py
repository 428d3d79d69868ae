"""Standard control methods with which the project's own method is compared."""
