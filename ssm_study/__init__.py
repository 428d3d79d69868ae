"""From input-output data of a nonlinear system to a certified output-feedback controller."""

__version__ = "0.1.0"
