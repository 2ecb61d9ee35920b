"""Environments of Gymnasium as plants."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from .._core.arguments import package
from .._core.boundary.checked import checked
from .._core.boundary.kinds import NewOptionalNames, Positive, SignalNames
from ..errors import ComputationError, DefinitionError


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


class GymnasiumPlant:
    """An environment as a plant: see `from_gymnasium`."""

    fixed_step = True

    def __init__(
        self,
        environment: Any,
        inputs: Sequence[str] | Mapping[str, str],
        signals: tuple[str, ...],
        dt: float,
        policy: Any,
        period: float | None,
    ):
        self._given = environment, inputs, signals, dt, policy, period
        self.inputs, self.dt, self.period = inputs, dt, period
        self._signals, self._policy = signals, policy
        gym = package("gymnasium")
        # (Time limits of a registered environment would end experiments.)
        make = (
            (lambda: gym.make(environment).unwrapped)
            if isinstance(environment, str)
            else environment
        )
        self._environment = make()
        shapes = self._environment.observation_space.shape, self._environment.action_space.shape
        if shapes != ((len(signals),), (len(inputs),)):
            raise DefinitionError(
                f"observations and actions have the shapes {shapes}: give as many `signals` and "
                "`inputs`."
            )
        self._dtype = self._environment.action_space.dtype
        self._seen: Any = None

    def __reduce__(self) -> Any:
        return GymnasiumPlant, self._given

    def reset(self, seed: int) -> Mapping[str, float]:
        """Begin an episode."""
        self._seen, _ = self._environment.reset(seed=seed)
        return dict(zip(self._signals, self._seen.tolist(), strict=True))

    def step(self, u: Sequence[float], duration: float) -> Mapping[str, float]:
        """Take one step."""
        action = np.array(u, float)
        if self._policy is not None:
            action += self._policy(self._seen)
        self._seen, _, terminated, truncated, _ = self._environment.step(action.astype(self._dtype))
        if terminated or truncated:
            raise ComputationError(f"the episode was {'terminated' if terminated else 'truncated'}")
        return dict(zip(self._signals, self._seen.tolist(), strict=True))
