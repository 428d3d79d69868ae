"""From the table to figures and a page."""
