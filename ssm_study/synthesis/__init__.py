"""Controllers and observers with certificates: one theorem per file, and exact verification."""
