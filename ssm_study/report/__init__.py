"""From the table to figures, a page, and controllers for use elsewhere."""
