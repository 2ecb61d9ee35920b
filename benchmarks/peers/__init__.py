"""Other libraries at the same job, each used as a good user of it would.

Each module has `setup(job)`, which compiles, and `run(job, ready, ...)`, which takes what `setup`
gave and returns the record (S, n, 2); both raise `Unavailable` where the library is missing.
"""
