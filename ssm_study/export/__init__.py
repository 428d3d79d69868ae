"""The controller for use elsewhere."""
