"""Rhythms of which the times of events are known: intervals, and the phase response curve."""
