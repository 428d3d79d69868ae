"""Signals that excite a plant."""
