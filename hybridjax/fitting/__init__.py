"""Physical parameters from data."""
