"""Data of strangers: generators in plain NumPy, which do not import the package.

Each returns data and the truth of `benchmarks/strangers.py`.
"""

from typing import NamedTuple

import numpy as np


class Loop(NamedTuple):
    """A linear system with period N: x[i + 1] = A[n] x[i] + B[n] u[i], y[i] = C[n] x[i], with n = i
    mod N."""

    A: np.ndarray
    """(N, d, d)"""
    B: np.ndarray
    """(N, d, 1)"""
    C: np.ndarray
    """(N, ny, d)"""

    @property
    def multipliers(self) -> np.ndarray:
        """Eigenvalues of the product over a period, by decreasing modulus."""
        product = np.eye(self.A.shape[1])
        for matrix in self.A:
            product = matrix @ product
        values = np.linalg.eigvals(product).astype(complex)
        return values[np.argsort(-np.abs(values))]

    def response(self, u: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Return outputs (S, n, ny) for inputs (S, n, 1), from rest.

        **Arguments:** `noise` (S, n, d): added to the states after each section.
        """
        N = len(self.A)
        x = np.zeros((len(u), self.A.shape[1]))
        y = np.zeros((*u.shape[:2], self.C.shape[1]))
        for i in range(u.shape[1]):
            n = i % N
            y[:, i] = x @ self.C[n].T
            x = x @ self.A[n].T + u[:, i] @ self.B[n].T
            if noise is not None:
                x = x + noise[:, i]
        return y


def loop_with(
    multipliers: list[complex], N: int, outputs: int, rng: np.random.Generator
) -> Loop:
    """Return a random loop with given multipliers (of a pair the upper one alone)."""
    blocks = []
    for z in np.asarray(multipliers, complex):
        if z.imag:
            blocks.append(np.array([[z.real, z.imag], [-z.imag, z.real]]))
        else:
            blocks.append(np.array([[z.real]]))
    d = sum(len(block) for block in blocks)
    core = np.zeros((d, d))
    at = 0
    for block in blocks:
        core[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    # States between sections are turned at random, and return after a period.
    frames = [np.eye(d) + 0.4 * rng.normal(size=(d, d)) for _ in range(N)]
    frames.append(frames[0])
    A = []
    for n in range(N):
        stage = core if n == N - 1 else np.eye(d)
        A.append(frames[n + 1] @ stage @ np.linalg.inv(frames[n]))
    B = rng.normal(size=(N, d, 1))
    C = rng.normal(size=(N, outputs, d))
    return Loop(np.array(A), B, C)


def periodic_response(loop: Loop, u: np.ndarray, settle: int = 60) -> np.ndarray:
    """Return the periodic response to periodic inputs (S, n, 1)."""
    repeats = -(-settle * len(loop.A) // u.shape[1]) + 1
    y = loop.response(np.tile(u, (1, repeats, 1)))
    return y[:, -u.shape[1] :]


class Rhythm(NamedTuple):
    """A recorded rhythm: dz/dt = (mu + i omega) z - mu |z|^2 z + u, a limit cycle of modulus 1.

    Deviations of the modulus decay by exp(-2 mu T) in a period T.
    """

    time: np.ndarray
    u: np.ndarray
    x: np.ndarray
    y: np.ndarray
    strikes: np.ndarray
    """Times at which y rises through 0."""
    multiplier: float


def rhythm(
    rng: np.random.Generator,
    duration: float = 200.0,
    rate: float = 100.0,
    mu: float = 0.35,
    push: float = 0.3,
    noise: float = 0.002,
) -> Rhythm:
    """Return a recording with a period of 1 s, and pushes that are held for a tenth of it."""
    fine = 10
    step = 1 / rate / fine
    steps = int(duration * rate) * fine
    held = int(0.1 / step)
    u = np.repeat(push * rng.normal(size=steps // held + 1), held)[:steps]
    z = np.empty(steps, complex)
    now = 1.0 + 0.0j
    omega = 2 * np.pi

    def slope(z: complex, force: float) -> complex:
        return (mu + 1j * omega) * z - mu * abs(z) ** 2 * z + force

    for k in range(steps):
        z[k] = now
        middle = now + step / 2 * slope(now, u[k])
        now = now + step * slope(middle, u[k])
    t = np.arange(steps) * step
    y = z.imag
    at = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    strikes = t[at] - y[at] * step / (y[at + 1] - y[at])
    kept = slice(None, None, fine)
    x_seen = z.real[kept] + noise * rng.normal(size=steps // fine)
    y_seen = y[kept] + noise * rng.normal(size=steps // fine)
    return Rhythm(t[kept], u[kept], x_seen, y_seen, strikes, float(np.exp(-2 * mu)))


def smooth_maps(rng: np.random.Generator, n: int, points: int = 60) -> np.ndarray:
    """Return normal curves (n, points) of variance 1, correlated over six points."""
    kernel = np.exp(-0.5 * (np.arange(-18, 19) / 6) ** 2)
    kernel /= np.linalg.norm(kernel)
    white = rng.normal(size=(n, points + 36))
    return np.array([np.convolve(row, kernel, "valid") for row in white])


def lognormal_maps(
    rng: np.random.Generator, n: int, size: float, points: int = 60
) -> tuple[np.ndarray, float]:
    """Return lognormal curves, and their mean."""
    return np.exp(size * smooth_maps(rng, n, points)), float(np.exp(size**2 / 2))


# Sizes and spreads of two groups without a difference.
GROUPS = [
    (6, 2.0, 14, 1.0),
    (8, 1.5, 24, 1.0),
    (6, 2.0, 6, 1.0),
    (14, 2.0, 6, 1.0),
    (10, 1.0, 10, 1.0),
    (5, 3.0, 20, 1.0),
    (12, 1.0, 12, 3.0),
    (6, 1.0, 30, 1.0),
]


def noisy_series(
    multipliers: list[complex], seed: int, size: float, color: float
) -> tuple[Loop, np.ndarray, np.ndarray]:
    """Return a random loop with three sections, and inputs and outputs of three records.

    **Arguments:** `size`: of the noise that drives the states. `color`: part of an input that is
    left after a section (0: white).
    """
    rng = np.random.default_rng(seed)
    loop = loop_with(multipliers, 3, 2, rng)
    u = rng.normal(size=(3, 300, 1))
    for i in range(1, 300):
        u[:, i] = color * u[:, i - 1] + np.sqrt(1 - color**2) * u[:, i]
    y = loop.response(u, size * rng.normal(size=(3, 300, loop.A.shape[1])))
    return loop, u, y + 0.1 * y.std(axis=(0, 1)) * rng.normal(size=y.shape)


def controlled_series(seed: int) -> tuple[Loop, np.ndarray, np.ndarray]:
    """Return the same of a loop whose controller acts at the section where it measures.

    Loops that the controller makes unstable are drawn again.
    """
    rng = np.random.default_rng(seed)
    while True:
        loop = loop_with([0.5 + 0.45j], 3, 2, rng)
        gain = 0.2 * rng.normal(size=(2, 1))
        x = np.zeros((3, 2))
        u = np.zeros((3, 450, 1))
        y = np.zeros((3, 450, 2))
        for i in range(450):
            n = i % 3
            y[:, i] = x @ loop.C[n].T + 0.05 * rng.normal(size=(3, 2))
            u[:, i] = rng.normal(size=(3, 1)) - y[:, i] @ gain
            x = x @ loop.A[n].T + u[:, i] @ loop.B[n].T + 0.3 * rng.normal(size=(3, 2))
            x = np.clip(x, -1e3, 1e3)
        if np.abs(x).max() < 1e2:
            return loop, u, y


# Multipliers of loops whose reference is recorded (of a pair the upper one).
REFERENCED: list[list[complex]] = [
    [0.7],
    [0.5 + 0.45j],
    [0.8, 0.3],
    [0.3 + 0.6j],
    [0.6, -0.4],
    [0.75, 0.5],
]


def referenced_series(
    kind: int, seed: int, noise: float
) -> tuple[Loop, np.ndarray, np.ndarray, np.ndarray]:
    """Return a random loop of four sections under u = r - K y, and r, u and y of two records.

    **Arguments:** `kind`: index of `REFERENCED`; one loop and controller each. `noise`: of the
    input, relative to r.
    """
    rng = np.random.default_rng((kind, 7))
    while True:
        loop = loop_with(REFERENCED[kind], 4, 2, rng)
        gain = 0.15 * rng.normal(size=(2, 1))
        product = np.eye(loop.A.shape[1])
        for A, B, C in zip(loop.A, loop.B, loop.C, strict=True):
            product = (A - B @ gain.T @ C) @ product
        if np.abs(np.linalg.eigvals(product)).max() < 0.9:
            break
    rng = np.random.default_rng((kind, seed))
    S, cycles, N, d = 2, 200, 4, loop.A.shape[1]
    size = loop.response(rng.normal(size=(1, 400, 1))).std()
    x = np.zeros((S, d))
    r = rng.normal(size=(S, cycles * N, 1))
    u = np.zeros_like(r)
    y = np.zeros((S, cycles * N, 2))
    for i in range(cycles * N):
        n = i % N
        y[:, i] = x @ loop.C[n].T + 0.1 * size * rng.normal(size=(S, 2))
        u[:, i] = r[:, i] - y[:, i] @ gain
        acts = u[:, i] + noise * rng.normal(size=(S, 1))
        x = x @ loop.A[n].T + acts @ loop.B[n].T
    return loop, r, u, y


def weak_series(
    multipliers: list[complex], weak: complex, size: float, seed: int
) -> tuple[Loop, np.ndarray, np.ndarray]:
    """Return a random loop with three sections, and inputs and outputs of three records.

    **Arguments:** `weak`: a further multiplier, real, that inputs excite by `size` relative to the
    others.
    """
    rng = np.random.default_rng((seed, 11))
    loop = loop_with([*multipliers, weak], 3, 2, rng)
    product = loop.A[2] @ loop.A[1] @ loop.A[0]
    values, modes = np.linalg.eig(product)
    weakest = int(np.argmin(np.abs(values - weak)))
    scales = np.ones(len(values))
    scales[weakest] = size
    shrink = (modes * scales @ np.linalg.inv(modes)).real
    # In the frame of each section, the part of its input along the weak mode is smaller.
    to_next = [loop.A[0], loop.A[1] @ loop.A[0], product]
    B = np.array(
        [
            way @ shrink @ np.linalg.inv(way) @ b
            for way, b in zip(to_next, loop.B, strict=True)
        ]
    )
    loop = loop._replace(B=B)
    u = rng.normal(size=(3, 450, 1))
    y = loop.response(u)
    return loop, u, y + 0.1 * y.std(axis=(0, 1)) * rng.normal(size=y.shape)


# Multipliers of rhythms that nobody perturbs (of a pair the upper one).
NATURAL: list[list[complex]] = [
    [0.2],
    [0.5],
    [0.7],
    [0.9],
    [0.95],
    [-0.7],
    [0.3 * np.exp(1j)],
    [0.6 * np.exp(1j)],
    [0.9 * np.exp(1j)],
]


def unperturbed_rhythm(
    multipliers: list[complex], cycles: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return three outputs at eight sections a cycle of a random loop that noise drives at each
    section, with noise of a fifth of their standard deviations, and the true multipliers."""
    rng = np.random.default_rng((seed, cycles, 13))
    loop = loop_with(multipliers, 8, 3, rng)
    settle = 40
    n = (cycles + settle) * 8
    y = loop.response(np.zeros((1, n, 1)), rng.normal(size=(1, n, len(loop.A[0]))))
    y = y[0, settle * 8 :]
    return y + 0.2 * y.std(axis=0) * rng.normal(size=y.shape), loop.multipliers
