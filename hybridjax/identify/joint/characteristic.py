"""The characteristic polynomial of a periodic model, and its derivatives."""

import numpy as np
from jaxtyping import Float

from .coordinates import LocalCoordinates


def characteristic_slopes(
    coordinates: LocalCoordinates,
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, "d P"]]:
    r"""Coefficients $c_1, \ldots, c_d$ of $\det(\lambda I - \Phi)$, and their derivatives.

    At the section with the smallest dimension d (Faddeev and Leverrier's recursion).
    """
    model, places = coordinates.model, coordinates.places
    N, first = model.n_sections, int(np.argmin(model.dims))
    phi, d = model.monodromy(first), min(model.dims)
    M, c, by_phi = np.eye(d), [], []
    for k in range(1, d + 1):
        by_phi.append(-M.T)
        c.append(-np.trace(phi @ M) / k)
        M = phi @ M + c[-1] * np.eye(d)
    slopes = np.zeros((d, coordinates.size))
    order = [(first + k) % N for k in range(N)]
    before = [np.eye(d)]
    for n in order[:-1]:
        before.append(model.A[n] @ before[-1])
    after = np.eye(d)
    for n, entering in zip(reversed(order), reversed(before), strict=True):
        left, at = after @ coordinates.to_A[n], places[n]["Y"]
        slopes[:, at] = (left.T @ np.array(by_phi) @ entering.T).reshape(d, -1)
        after = after @ model.A[n]
    return np.array(c), slopes
