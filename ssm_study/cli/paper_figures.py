"""Figures of the paper, which are drawn at the end of every run."""

PAPER_FIGURES = ("validation_trajectory", "closed_loop_responses")
