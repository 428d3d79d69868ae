"""Plants whose records can hide what a loop meets, and how the prediction does on them."""
