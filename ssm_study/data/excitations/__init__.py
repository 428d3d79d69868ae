"""Excitation signals for identification experiments."""
