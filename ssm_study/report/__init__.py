"""Figures, terminal output and web page that are made from the table of a study."""
