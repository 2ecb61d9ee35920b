"""Environments of Gymnasium as plants."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.boundary.checked import checked
from .._core.boundary.kinds import NewOptionalNames, Positive, SignalNames
from ..errors import ComputationError, DefinitionError
from .plant import Made


@checked
def from_gymnasium(
    environment: str | Callable[[], Any],
    inputs: NewOptionalNames,
    signals: SignalNames,
    *,
    dt: Positive,
    policy: Callable[[Any], Any] | None = None,
    period: Positive | None = None,
) -> "GymnasiumPlant":
    """Make a plant of a Gymnasium environment (`pip install 'hybridjax[gym]'`).

    Environments have fixed steps and states that cannot be set: sections are interpolated between
    two steps, inputs change at the step after a section, and each experiment settles anew. An
    experiment ends where the environment is terminated or truncated.

    **Arguments:**

    - `environment`: a registered name, or a function that makes the environment.
    - `inputs`: names of the actions, or units by name. An input is added to what `policy` returns.
    - `signals`: names of the entries of an observation.
    - `dt`: time between two steps in seconds.
    - `policy`: function of the observation that returns the actions, without memory. Default:
        zero.
    - `period`: period of the clock in seconds. Default: no clock.

    **Raises:** `DefinitionError` for names that do not fit.
    """
    return GymnasiumPlant(environment, inputs, tuple(signals), dt, policy, period)


@dataclasses.dataclass(eq=False)
class GymnasiumPlant(Made):
    """An environment as a plant: see `from_gymnasium`."""

    fixed_step = True
    environment: Any
    inputs: Sequence[str] | Mapping[str, str]
    signals: tuple[str, ...]
    dt: float
    policy: Any
    period: float | None

    def __post_init__(self) -> None:
        gym, make = package("gymnasium"), self.environment
        # (Time limits of a registered environment would end experiments.)
        self._made = gym.make(make).unwrapped if isinstance(make, str) else make()
        shapes = self._made.observation_space.shape, self._made.action_space.shape
        if shapes != ((len(self.signals),), (len(self.inputs),)):
            raise DefinitionError(
                f"observations and actions have the shapes {shapes}: give as many `signals` and "
                "`inputs`."
            )

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin an episode."""
        self._z, _ = self._made.reset(seed=seed)
        return dict(zip(self.signals, self._z.tolist(), strict=True))

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Take one step."""
        action = np.array(u, float)
        if self.policy is not None:
            action += self.policy(self._z)
        action = action.astype(self._made.action_space.dtype)
        self._z, _, terminated, truncated, _ = self._made.step(action)
        if terminated or truncated:
            raise ComputationError(f"the episode was {'terminated' if terminated else 'truncated'}")
        return dict(zip(self.signals, self._z.tolist(), strict=True))
