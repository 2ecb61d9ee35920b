"""Kernels: small programs of single points, found again by what they compute."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hybridjax._core.compilation import compilation_cache, fingerprint, kernel
from hybridjax._core.lanes.per_lane import PerLane, by_lane


FACTOR = 3.0
X = np.linspace(0.0, 1.0, 4)[None]
Y = np.ones((1, 1))


def point(power, tree, x, y):
    return tree["k"] * FACTOR * jnp.sin(x) ** power + y


def plain(function, *trees):
    return by_lane(function, *trees)


def summed(function, *trees):
    """Another form than `by_lane`."""
    each = by_lane(function, *trees)
    return lambda x, y: each(x, y) + each(y, x)


def call(tree, power=2, lanes=1, form=plain) -> Any:
    return kernel.kernel(point, form, (power,), (tree,), lanes)(X, Y)


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    """No program in memory, a folder on disk, and functions of these tests as if they were ours."""
    monkeypatch.setattr(fingerprint, "_PACKAGE", __name__.partition(".")[0])
    monkeypatch.setattr(compilation_cache, "_folder", tmp_path)
    forget()
    yield tmp_path / "programs"
    forget()


@pytest.fixture
def made(monkeypatch):
    """How often a program was compiled."""
    made = []

    def compiling(*arguments):
        made.append(arguments)
        return compiled(*arguments)

    compiled = kernel.compiled
    monkeypatch.setattr(kernel, "compiled", compiling)
    return made


def forget():
    kernel._program.cache_clear()


def expected(k=1.0, power=2, factor=3.0):
    return k * factor * np.sin(X) ** power + Y


def test_a_kernel_is_found_by_the_next_process(made):
    tree = {"k": jnp.asarray(1.0)}
    for k in (1.0, 2.0):
        np.testing.assert_allclose(call({"k": jnp.asarray(k)}), expected(k), rtol=1e-15)
    assert len(made) == 1
    forget()
    np.testing.assert_array_equal(call(tree), call(tree))
    np.testing.assert_allclose(call(tree), expected(), rtol=1e-15)
    assert len(made) == 1


def test_what_is_changed_makes_another_kernel(made, monkeypatch):
    tree = {"k": jnp.asarray(1.0)}
    call(tree)
    np.testing.assert_allclose(call(tree, power=3), expected(power=3), rtol=1e-15)
    call(tree, lanes=4)
    both = expected() + 3 * np.sin(Y) ** 2 + X
    np.testing.assert_allclose(call(tree, form=summed), both, rtol=1e-14)
    forget()
    monkeypatch.setitem(globals(), "FACTOR", 5.0)
    np.testing.assert_allclose(call(tree), expected(factor=5.0), rtol=1e-15)
    assert len(made) == 5


def test_damage_is_repaired(made, folder):
    tree = {"k": jnp.asarray(1.0)}
    call(tree)
    forget()
    (path,) = folder.iterdir()
    path.write_bytes(path.read_bytes()[:-1])
    np.testing.assert_allclose(call(tree), expected(), rtol=1e-15)
    assert len(made) == 2


def callback(tree, x, y):
    return jax.pure_callback(
        np.sin, jax.ShapeDtypeStruct(x.shape, float), x, vmap_method="sequential"
    )


def test_what_has_no_digest_is_compiled_as_any_other(made, folder):
    found = kernel.kernel(callback, plain, (), ({},), 1)(X, Y)
    np.testing.assert_allclose(found, np.sin(X), rtol=1e-15)
    k = np.linspace(1.0, 2.0, 4)
    own = PerLane({"k": jnp.asarray(k)}, (True,))
    np.testing.assert_allclose(call(own, lanes=4), expected(k), rtol=1e-15)
    assert not made and not folder.exists()


def test_without_a_folder_nothing_is_kept(made, monkeypatch):
    monkeypatch.setattr(compilation_cache, "_folder", None)
    np.testing.assert_allclose(call({"k": jnp.asarray(1.0)}), expected(), rtol=1e-15)
    assert not made
