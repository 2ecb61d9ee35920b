"""Rhythms of which only the times of events are known."""
