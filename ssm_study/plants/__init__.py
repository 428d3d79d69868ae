"""Plants that can be simulated and controlled."""
