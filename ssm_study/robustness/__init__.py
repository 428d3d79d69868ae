"""Model error measured from records, and stability of the closed loop in spite of the model
error."""
