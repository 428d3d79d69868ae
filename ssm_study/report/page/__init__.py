"""Interactive HTML page of a study. The report page: one self-contained file."""
