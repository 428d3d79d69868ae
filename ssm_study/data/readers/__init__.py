"""Readers of log files, one file per format. One file a format: columns of a recording."""
