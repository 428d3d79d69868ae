"""Model structures that are identified from records."""
