"""The temperature control laboratory: a heater, a sensor, and what the air takes away."""
