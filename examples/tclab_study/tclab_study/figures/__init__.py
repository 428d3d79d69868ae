"""Figures that `ssm-study report` finds beside its own."""
