"""From excitation or a file to a data set."""
