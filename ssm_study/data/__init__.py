"""Data sets for identification, from simulated plants or recorded logs. From excitation or a
file to a data set."""
