"""The models that are identified from records."""
