"""What the records say about the plant: its mismatch with the model, and whether a loop stands
it."""
