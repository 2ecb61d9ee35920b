"""Records on the axes record, cycle and section."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...experiments.record import Record


class CycleGrid(NamedTuple):
    """S records of T cycles; samples before a record, after it and in its gaps do not count."""

    u: Float[np.ndarray, "S T N nu"]
    """Inputs; zero where there is no record."""
    y: Float[np.ndarray, "S T N ny"]
    """Outputs; NaN where there is no sample."""
    inside: Bool[np.ndarray, "S T N"]
    """From the first sample of a record to its last."""
    drift: Float[np.ndarray, "S T K"]
    """What an unknown drift of each section's outputs is composed of; zero outside a record."""
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    lead: int
    """As in `Record`."""

    @property
    def n_sections(self) -> int:
        return self.y.shape[2]

    @classmethod
    def from_records(cls, records: Sequence[Record]) -> "CycleGrid":
        """Records of one kind, without unknown inputs, as one array."""
        S, T, about = len(records), max(map(count_cycles, records)), records[0]
        N, nu, ny = about.n_sections, len(about.inputs), len(about.outputs)
        u = np.zeros((S, T * N, nu))
        y = np.full((S, T * N, ny), np.nan)
        inside = np.zeros((S, T * N), bool)
        waves = [drift_waves(r) for r in records]
        drift = np.zeros((S, T, max(w.shape[1] for w in waves)))
        for s, (r, w) in enumerate(zip(records, waves, strict=True)):
            place = slice(r.first_section, r.first_section + len(r.u))
            u[s, place], y[s, place], inside[s, place] = r.u, r.y, True
            drift[s, : len(w), : w.shape[1]] = w
        return cls(
            u=u.reshape(S, T, N, nu),
            y=y.reshape(S, T, N, ny),
            inside=inside.reshape(S, T, N),
            drift=drift,
            inputs=about.inputs,
            outputs=about.outputs,
            lead=about.lead,
        )


def count_cycles(record: Record) -> int:
    """The cycles that a record touches, counted from section 0 of its first one."""
    return -(-(record.first_section + len(record.u)) // record.n_sections)


def drift_waves(record: Record) -> Float[np.ndarray, "T K"]:
    """What a drift is composed of: cosines in the cycles, down to a wavelength of `record.drift`.

    The first is a constant; none where the record announces no drift.
    """
    T = count_cycles(record)
    if record.drift is None:
        return np.zeros((T, 0))
    waves = np.arange(int(2 * T / record.drift) + 1)
    return np.cos(np.pi / T * (np.arange(T)[:, None] + 0.5) * waves)
