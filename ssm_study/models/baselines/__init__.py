"""Standard models with which the project's own models are compared."""
