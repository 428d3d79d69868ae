"""Findings on whether records and model allow a prediction for the plant."""
