"""Commands of the command line, and their messages for wrong requests."""
