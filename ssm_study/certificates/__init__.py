"""Claims about a design that exact arithmetic decides: theorems, one a file, and the certificates
they make."""
