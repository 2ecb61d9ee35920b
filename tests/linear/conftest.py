import numpy as np
import pytest

import hybridjax as hj


def blocks_at_random(seed, dims, ny, nu, gain=0.7):
    """Random matrices A, B, C, D; every `A[n]` has the norm `gain`."""
    rng = np.random.default_rng(seed)
    after = np.roll(dims, -1)
    A = [rng.normal(size=(i, j)) for i, j in zip(after, dims, strict=True)]
    A = [gain * a / np.linalg.norm(a, 2) for a in A]
    B = [rng.normal(size=(d, nu)) for d in after]
    C = [rng.normal(size=(ny, d)) for d in dims]
    D = [rng.normal(size=(ny, nu)) for _ in dims]
    return A, B, C, D


def simulate_blocks(blocks, u, x0, start=0):
    """The definition of an LDTP, in a loop over unpadded matrices."""
    A, B, C, D = blocks
    x = x0
    xs = [x0]
    ys = []
    for i, value in enumerate(u):
        n = (start + i) % len(A)
        output = C[n] @ x + D[n] @ value
        ys.append(output)
        forced = B[n] @ value
        x = A[n] @ x + forced
        xs.append(x)
    return xs, np.array(ys)


@pytest.fixture(scope="session")
def synthetic():
    """Dimensions 3, 2, 3, 2, 3, 2, two inputs, two outputs."""
    return hj.testing.synthetic_ldtp()


@pytest.fixture(scope="session")
def hopper(reference):
    data = reference("ldtp_isochron")
    return hj.linear.LDTP(
        data["A"],
        data["B"][..., None],
        data["C"],
        data["D"][..., None],
        data["dim"],
        inputs="u",
        outputs=("yM", "vM"),
    )
