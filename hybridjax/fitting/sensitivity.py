"""Which combinations of parameters the data see, and which they cannot."""

import itertools
from fractions import Fraction

import equinox as eqx
import numpy as np
from jaxtyping import Float


# Singular values of the sensitivities below this part of the largest one are zero. Doubled,
# combinations that are seen twice as well count as not seen.
_RANK = 1e-9
# Entries of a direction that are as close as this to zero, or to ratios of integers, are taken for
# these: they have no unit. Doubled, so are those twice as far.
_CLOSE = 1e-3
# The denominators of such ratios go up to this. Doubled, there are about four times as many.
_LARGEST_DENOMINATOR = 6
# Entries by which a basis is solved for, if their smallest singular value is above this. Doubled,
# forms whose other entries are half as large are left out.
_REGULAR = 1e-3


class Identifiability(eqx.Module):
    r"""Which combinations of parameters the data see, near some values of theirs.

    With the sensitivities $S_{ij} = p_j\,\partial r_i/\partial p_j$ of the weighted residuals to
    relative changes, the data do not see (to first order) changes in the null space of S: a row w
    of `unseen` says that $p_j \to p_j\, c^{w_j}$ for all j leaves them as they are (for a parameter
    that is zero, or has bounds on both sides or none: $p_j \to p_j + s_j w_j \log c$).

    **Fields:**

    - `names` (p,) of the parameters. `rank`: how many combinations are seen.
    - `singular_values` (p,) of S, the largest first. Where residuals are in units of standard
        deviations, one over a singular value is the relative standard error of its combination.
    - `unseen` (p - rank, p): a basis of the null space with as many zeros as possible, and small
        integers where it has such.
    - `sensitivity` (r, p): S.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    rank: int = eqx.field(static=True)
    singular_values: Float[np.ndarray, " p"]
    unseen: Float[np.ndarray, "k p"]
    sensitivity: Float[np.ndarray, "r p"]

    @property
    def complete(self) -> bool:
        """Whether every parameter is seen."""
        return self.rank == len(self.names)

    def descriptions(self) -> list[str]:
        """The combinations that the data cannot see, in words."""
        return [_describe(self.names, row) for row in self.unseen]

    def __repr__(self) -> str:
        seen = ", ".join(f"{x:.2g}" for x in self.singular_values[: self.rank])
        lost = ", ".join(f"{x:.1g}" for x in self.singular_values[self.rank :])
        lines = [
            f"Identifiability: {self.rank} of {len(self.names)} combinations of "
            f"({', '.join(self.names)}) are seen"
        ]
        lines += [f"  not seen: {text}" for text in self.descriptions()]
        lines.append(f"  singular values {seen}" + (f"; zero: {lost}" if lost else ""))
        return "\n".join(lines)


def diagnose(names: tuple[str, ...], sensitivity: Float[np.ndarray, "r p"]) -> Identifiability:
    """From the sensitivities S of weighted residuals to relative changes of the parameters."""
    _, values, rows = np.linalg.svd(sensitivity, full_matrices=True)
    values = np.concatenate([values, np.zeros(len(names) - len(values))])
    rank = int(np.sum(values > _RANK * values[0]))
    return Identifiability(names, rank, values, _readable(rows[rank:]), sensitivity)


def _readable(basis: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """The basis of the same space with the most zeros among those in echelon form."""
    k, p = basis.shape
    if k == 0:
        return basis

    def echelon(pivots):
        block = basis[:, pivots]
        if np.linalg.svd(block, compute_uv=False)[-1] < _REGULAR:
            return None
        return _rounded(np.linalg.solve(block, basis))

    forms = (echelon(list(pivots)) for pivots in itertools.combinations(range(p), k))
    forms = [form for form in forms if form is not None]
    return min(forms, key=lambda form: (np.count_nonzero(form), np.sum(form < 0)))


def _rounded(rows: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "k p"]:
    """Rows scaled to small integers where they are multiples of such."""
    out = []
    for row in rows:
        nearest = [Fraction(x).limit_denominator(_LARGEST_DENOMINATOR) for x in row]
        if max(abs(float(n) - x) for n, x in zip(nearest, row, strict=True)) < _CLOSE:
            common = np.lcm.reduce([n.denominator for n in nearest])
            row = np.array([float(n * int(common)) for n in nearest])
        out.append(np.where(np.abs(row) < _CLOSE, 0.0, row))
    return np.array(out)


def _describe(names: tuple[str, ...], row: Float[np.ndarray, " p"]) -> str:
    """One direction that is not seen, in words."""
    parts = [(name, w) for name, w in zip(names, row, strict=True) if w]
    if len(parts) == 1:
        return parts[0][0]
    together = ", ".join(name for name, _ in parts)
    if all(w == parts[0][1] for _, w in parts):
        only = f", only {parts[0][0]}/{parts[1][0]}" if len(parts) == 2 else ""
        return f"a common factor of ({together}){only}"
    if len(parts) == 2 and parts[0][1] == -parts[1][1]:
        return f"{parts[0][0]} and {parts[1][0]} apart, only their product"
    powers = ", ".join(name if w == 1 else f"{name}^{w:.3g}" for name, w in parts)
    return f"a common factor, with these powers, of ({powers})"
