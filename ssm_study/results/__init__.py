"""Stages, store, records, gathering into one tidy table, verification."""
