"""The commands, and what they answer to a wrong request."""
