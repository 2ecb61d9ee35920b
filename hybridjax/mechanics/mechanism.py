"""Mechanisms: masses, forces of motion, contacts and impacts from the kinetic and potential energy.

With the Lagrangian L = T - V and generalized forces f, Lagrange's equations are

    M(q) a + h(q, v) = f + J(q)' F,    M = d2T/dv2,    h = (d2T/dv dq) v - dL/dq,

where h holds the forces of Coriolis, of centrifugal acceleration and of gravity, and F are the
forces of the contacts whose coordinates c(q) have the derivative J = dc/dq (R. M. Murray, Z. Li, S.
S. Sastry, A Mathematical Introduction to Robotic Manipulation, 1994, ch. 4 and 6). No Christoffel
symbol is formed: h is one derivative along v of the momentum dT/dv, less one gradient.

Fields of models call the methods of `Mechanism`, each for one state. Signs are a contract with
them: forces and impulses act on the mechanism. If a motion is wrong, test `mass` and `bias` first,
from which accelerations follow: without forces, `energy` stays constant. If an impact is wrong,
look at `contact`, whose derivative it uses, then at `mass`.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._core.boundary.checked import checked
from .._core.executor import is_traced
from .._core.vector_math.factorizations import solve_positive
from ..errors import DefinitionError
from ..systems.drawing import Drawing
from ..systems.structure import as_vector


class Constrained(NamedTuple):
    """Motion under contacts."""

    acceleration: Float[Array, " n"]
    force: Float[Array, " k"]
    """Of the contacts on the mechanism, along the k coordinates of the contacts."""


class Impact(NamedTuple):
    """What an impact does."""

    velocity: Float[Array, " n"]
    """After it."""
    impulse: Float[Array, " k"]
    """Of the contacts on the mechanism, along the k coordinates of the contacts."""


_DEPENDENT = (
    "the coordinates of `contact` must be independent; their inverse mass matrix is"
)


def _no_potential(q):
    return 0.0


@checked
class Mechanism(eqx.Module):
    """A mechanism with n coordinates q and velocities v = dq/dt, given by its energies.

    **Fields:**

    - `kinetic`: T(q, v) -> number, a polynomial of degree two in v; from a mass matrix,
        `lambda q, v: 0.5 * v @ M(q) @ v`.
    - `potential`: V(q) -> number. Default: 0.
    - `links`: for pictures, a function of q that returns the points (k, 2) of each link by name, in
        meters. Default: none.

    Methods take one state, in fields, guards, resets and outputs. They compile to plain arithmetic
    operations without LAPACK. If the mass matrix is singular or not positive, or contacts are not
    independent, methods raise `DefinitionError` for arrays of numbers. In fields and resets they
    return NaN, and the trajectory ends with `Result.FIELD_NOT_FINITE`.

    **Example:**

    ```python
    import jax.numpy as jnp

    kinetic = lambda q, v: 0.5 * v[0] ** 2
    pendulum = hj.systems.Mechanism(kinetic, lambda q: -9.81 * jnp.cos(q[0]))
    print(pendulum.acceleration(jnp.array([0.1]), jnp.array([0.0]), jnp.array([0.0])))
    ```

    **After:** `hj.Chart`, whose vector field uses `acceleration`.
    """

    kinetic: Callable[[Any, Any], Any]
    potential: Callable[[Any], Any] = _no_potential  # (which can be pickled)
    links: Callable[[Any], Mapping[str, Any]] | None = None

    def draw(
        self,
        q: Float[Array, " n"],
        ground: ArrayLike | None = None,
        body: str | None = None,
    ) -> Drawing:
        """The links, with a point at the end of each that has its name (see `Drawing`).

        **Raises:** `DefinitionError` for a mechanism without `links`.
        """
        if self.links is None:
            raise DefinitionError(
                "the mechanism has no `links` to draw: give them to Mechanism."
            )
        lines = {name: jnp.asarray(link, float) for name, link in self.links(q).items()}
        points = {name: link[-1] for name, link in lines.items()}
        below = {} if ground is None else {"ground": ground}
        return Drawing({**below, **lines}, points=points, body=body)

    def energy(self, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, ""]:
        """T + V."""
        return jnp.asarray(self.kinetic(q, v) + self.potential(q))

    def mass(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """The mass matrix M(q)."""
        return jax.hessian(self.kinetic, 1)(q, jnp.zeros_like(q))

    def bias(self, q: Float[Array, " n"], v: Float[Array, " n"]) -> Float[Array, " n"]:
        """h(q, v) = C(q, v) v + G(q): the forces that keep the velocities as they are."""

        def lagrangian(q, v):
            return jnp.asarray(self.kinetic(q, v) - self.potential(q))

        def slopes(q):
            return jax.grad(lagrangian, (0, 1))(q, v)

        (force, _), (_, change) = jax.jvp(slopes, (q,), (v,))
        return change - force

    def acceleration(
        self,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        force: ArrayLike = 0.0,
    ) -> Float[Array, " n"]:
        """a = dv/dt in M a + h = f, under generalized forces f: n numbers, or one for all."""
        return _solve(self.mass(q), force - self.bias(q, v))

    def constrained(
        self,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        force: ArrayLike,
        contact: Callable[[Any], Any],
    ) -> Constrained:
        """The acceleration while contacts are closed, and the contact forces.

        **Arguments:** `contact`, a function c(q) that returns the k < n independent coordinates
        that the contacts fix, as an array (k,): for example the position of a foot on the ground.
        States should satisfy c = const. and J v = 0. An error in these is not corrected: J v keeps
        its value up to rounding, and c drifts accordingly.
        """

        def place(q):
            return as_vector(contact(q)).ravel()

        def speed(q):
            return jax.jvp(place, (q,), (v,))[1]

        # (The drift is the part of the contact's acceleration that the velocities make.)
        jacobian = jax.jacfwd(place)(q)
        drift = jax.jvp(speed, (q,), (v,))[1]
        solved = _solve(
            self.mass(q), jnp.concatenate([(force - self.bias(q, v))[None], jacobian])
        )
        free = solved[0]
        by_force = solved[1:].T
        constraint = _solve(jacobian @ by_force, -(drift + jacobian @ free), _DEPENDENT)
        return Constrained(free + by_force @ constraint, constraint)

    def impact(
        self,
        q: Float[Array, " n"],
        v: Float[Array, " n"],
        contact: Callable[[Any], Any],
        restitution: ArrayLike = 0.0,
    ) -> Impact:
        """A rigid impact: impulses act at the contacts only, and q does not change.

        M (v+ - v) = J' P and J v+ = -e J v (Y. Hurmuzlu, D. B. Marghitu, Rigid body collisions of
        planar kinematic chains with multiple contact points, Int. J. Robotics Research 13, 1994).
        To exchange left and right after the impact, permute q and the returned velocity. The
        `impulse` shows whether a contact pulls (a negative normal impulse) or would slip.

        **Arguments:** `contact`, the coordinates c(q) of the contacts made, k <= n independent ones
        as an array (k,); `restitution`, e: 0 for a contact that sticks; a number, or k of them.
        """
        jacobian = jax.jacfwd(lambda q: as_vector(contact(q)).ravel())(q)
        by_impulse = _solve(self.mass(q), jacobian).T
        impulse = _solve(
            jacobian @ by_impulse, -(1 + restitution) * (jacobian @ v), _DEPENDENT
        )
        return Impact(v + by_impulse @ impulse, impulse)

    def along(self, placement: Callable[[Any], Any]) -> "Mechanism":
        """The mechanism in fewer coordinates p, which determine the original ones: q =
        placement(p).

        A biped whose coordinates are those of the hip and angles of its links becomes one that
        stands on a foot: `biped.along(lambda angles: [*hip_above_foot(angles), *angles])`.
        """

        def place(p):
            return as_vector(placement(p))

        return Mechanism(
            lambda p, v: self.kinetic(*jax.jvp(place, (p,), (v,))),
            lambda p: self.potential(place(p)),
            None if self.links is None else lambda p: self.links(place(p)),  # type: ignore[misc]
        )


def _solve(mass, right, text="the kinetic energy must be positive; its mass matrix is"):
    """**Raises:** `DefinitionError` for a matrix of mass that is singular or not positive."""
    solution = solve_positive(mass, right)
    if not is_traced(solution) and np.isnan(solution).any():
        raise DefinitionError(f"{text} {mass}.")
    return solution
