import gc

import equinox as eqx
import jax
import jax.numpy as jnp

from hybridjax._core.memo import remembered


class Box(eqx.Module):
    value: jax.Array

    @remembered
    def double(self):
        """Twice the value."""
        calls.append(self)
        return 2 * self.value


calls = []


def test_it_is_computed_once_and_leaves_the_structure_as_it_is():
    calls.clear()
    box = Box(jnp.asarray(3.0))
    before = jax.tree_util.tree_structure(box)
    assert box.double == 6 and box.double == 6 and len(calls) == 1
    assert jax.tree_util.tree_structure(box) == before


def test_copies_with_other_values_have_their_own():
    box = Box(jnp.asarray(3.0))
    assert box.double == 6
    assert eqx.tree_at(lambda x: x.value, box, jnp.asarray(4.0)).double == 8


def test_it_is_forgotten_with_its_object():
    calls.clear()
    values = Box.double.memory
    size = len(values)
    box = Box(jnp.asarray(1.0))
    assert box.double == 2 and len(values) == size + 1
    del box
    calls.clear()
    gc.collect()
    assert len(values) == size
