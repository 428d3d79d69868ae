"""The controller meets the plant."""
