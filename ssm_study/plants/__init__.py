"""Plants that are simulated and controlled."""
