"""Export of a controller for use outside this package."""
