"""Mismatch between plant and model, measured from records, and the stability of a loop under it."""
