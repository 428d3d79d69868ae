"""Static maps at a model's input and output, whose slopes have proved bounds."""
