"""Sweeps and Monte Carlo in pieces, on one machine or many, with results as labeled arrays."""
