"""What is identified."""
