"""Findings on whether records and model allow a prediction of the plant's behaviour."""
