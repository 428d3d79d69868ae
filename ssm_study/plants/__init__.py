"""The plants that are controlled."""
