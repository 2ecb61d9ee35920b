"""Multipliers from natural variability: nothing is known of what disturbs the rhythm."""
