"""What is controlled."""
