"""Where JAX computes."""

import jax
import jax.numpy as jnp

from hybridjax._core.device import on_cpu
from hybridjax._core.threads import thread_count


def test_default_device_counts_more_than_the_backend(monkeypatch):
    """A CPU that is asked for on a machine with a GPU is a CPU."""
    assert on_cpu()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not on_cpu() and thread_count(None) == 1
    with jax.default_device(jax.devices("cpu")[0]):
        assert on_cpu()
    with jax.default_device("cpu"):
        assert on_cpu() and jnp.ones(1).devices() == {jax.devices("cpu")[0]}
    assert not on_cpu()
