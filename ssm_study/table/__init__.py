"""Modules that gather the runs of a study into one table, then filter, sort and print the table."""
