"""Parameters that must be positive, such as masses."""

import equinox as eqx
import jax.numpy as jnp
import pytest

import hybridjax as hj


class Ball(hj.Chart):
    states = ("y", "v")
    owner: "Bouncing"

    def field(self, t, q, u):
        push = u[0] / self.owner.m
        return q[1], -9.81 + push


class Bouncing(hj.HybridSystem):
    m: hj.Parameter = hj.parameter(1.0, unit="kg", positive=True)
    push: hj.Parameter = hj.parameter(-1.0, unit="N")

    def charts(self):
        return {"air": Ball(self)}


def refused(match, call, *arguments, **options):
    with pytest.raises(hj.errors.DefinitionError, match=match):
        call(*arguments, **options)


@pytest.mark.parametrize("mass", [-1.0, 0.0])
def test_masses_must_be_positive(mass):
    refused("Bouncing: `m` must be a positive number", Bouncing, m=mass)
    # Where the constructor does not see the value, the first call does.
    changed = eqx.tree_at(lambda x: x.m, Bouncing(), jnp.asarray(mass))
    says = rf"parameter `m` of Bouncing is {mass:g} kg: it must be positive"
    refused(says, hj.simulate, changed, "air", (1.0, 0.0), 0.1)
    hoppers = eqx.filter_vmap(lambda m: hj.models.VerticalHopper(M=m))
    cycle = hj.find_limit_cycle(hj.models.VerticalHopper())
    says = rf"parameter `M` of VerticalHopper is {mass:g}"
    wrong = hoppers(jnp.array([2.0, mass]))
    refused(says, hj.orbits.find_limit_cycles, wrong, cycle)
    refused("must be positive|`M` must be", hj.continuation, cycle, "M", (2.0, mass))


def test_masses_and_parts_of_circuits_of_the_gallery_are_declared_positive():
    for name in dir(hj.models):
        model = getattr(hj.models, name)
        fields = getattr(model, "__dataclass_fields__", {})
        for field in fields.values():
            if field.metadata.get("unit") in ("kg", "ohm", "H", "F", "pF"):
                assert field.metadata["positive"], (name, field.name)
