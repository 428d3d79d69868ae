"""The plant's mismatch with the model, measured from records, and whether a loop stays stable with
it."""
