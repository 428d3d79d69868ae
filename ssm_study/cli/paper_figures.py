"""Figures of the paper, which every run draws at its end."""

PAPER_FIGURES = ("validation_trajectory", "closed_loop_responses")
