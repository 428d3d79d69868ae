"""One file a format: columns of a recording."""
