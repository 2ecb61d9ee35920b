"""How much may be asked for in one call, so that a slip of the hand ends in a sentence and not in
a computer without memory."""

COUNT = 1_000_000_000
"""Of anything else."""
SECTIONS = 100_000
"""Of a family."""
PERIODS = 10_000_000
"""Cycles, periods and samples in one record or experiment."""
EXPERIMENTS = 10_000_000
"""Experiments of a design, systems of a sweep."""
ORDER = 1_000
"""Multipliers of a model."""
STEPS = 100_000_000
"""Of an iteration."""
WORKERS = 10_000
"""Threads."""
