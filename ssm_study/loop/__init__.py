"""Closed loop of controller and plant, its trajectories and the measures of its behaviour."""
