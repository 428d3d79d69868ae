"""Model error of a plant, measured from records, and the stability of a loop in spite of it."""
