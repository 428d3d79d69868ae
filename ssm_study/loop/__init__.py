"""Closed loop of controller and plant, its trajectories and its measures."""
