"""Certificates of a design: theorems as matrix inequalities that exact arithmetic decides.
Claims about a design that exact arithmetic decides: theorems, one a file, and the certificates
they make."""
