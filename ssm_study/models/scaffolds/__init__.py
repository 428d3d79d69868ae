"""Static maps around the recurrence, with slopes that can be certified."""
