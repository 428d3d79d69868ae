"""Static maps around the recurrence, whose slopes can be certified."""
