"""Standard models with which the project's own model is compared."""
