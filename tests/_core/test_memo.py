import gc
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp

from hybridjax._core.memo import Memory, Recent, remembered


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
    assert box.double == 6
    assert box.double == 6
    assert len(calls) == 1
    assert jax.tree_util.tree_structure(box) == before
    other = eqx.tree_at(lambda x: x.value, box, jnp.asarray(4.0))
    assert other.double == 8


def test_it_is_forgotten_with_its_object():
    calls.clear()
    values = Box.double.memory._values
    size = len(values)
    box = Box(jnp.asarray(1.0))
    assert box.double == 2
    assert len(values) == size + 1
    del box
    calls.clear()
    gc.collect()
    assert len(values) == size


def test_objects_that_come_and_go_in_threads():
    """Ids are used again; each object sees its own value only."""
    memory = Memory()

    def work(seed):
        for k in range(500):
            box = Box(seed + k)
            found = memory.recall(box, "key", lambda box=box: box.value)
            assert found == seed + k

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(0, 80_000, 10_000)))
    gc.collect()
    assert not memory._values


def test_recent_values_are_those_of_their_objects_and_older_ones_are_dropped():
    recent = Recent(2)
    boxes = [Box(jnp.asarray(1.0)) for _ in range(3)]
    for number, box in enumerate(boxes):
        assert recent.get(box) is None
        assert recent.keep(number, box) == number
    kept = [recent.get(box) for box in boxes]
    assert kept == [None, 1, 2]
    assert recent.get(boxes[1], boxes[2]) is None
