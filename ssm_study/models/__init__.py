"""Model structures that can be identified from records."""
