"""Static maps at a model's input and output, with slopes that can be certified."""
