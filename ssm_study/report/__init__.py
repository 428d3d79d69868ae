"""Figures, terminal output and web page from a study's table. From the table to figures and a
page."""
