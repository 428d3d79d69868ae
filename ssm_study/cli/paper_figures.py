"""Figures of the paper: every run draws them when it ends."""

PAPER_FIGURES = ("validation_trajectory", "closed_loop_responses")
