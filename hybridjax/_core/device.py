"""Where JAX computes."""

import jax


def on_cpu() -> bool:
    """Whether that is the CPU: as JAX's default, or because `jax.default_device` says so."""
    device = jax.config.jax_default_device  # a device, the name of a platform, or None
    platform = getattr(device, "platform", device)
    return (platform or jax.default_backend()) == "cpu"
