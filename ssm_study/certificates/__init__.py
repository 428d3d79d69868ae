"""What is claimed of a design and decided in exact arithmetic: theorems, one a file, and the
certificates they make."""
