"""A study as one table: gathered, filtered, ranked, shown."""
