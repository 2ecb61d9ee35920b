"""What an argument may be."""

from typing import Any

from .misfit import Misfit, show


class Kind:
    """What an argument may be. Instances stand in `Annotated[...]`, or are made from a plain type
    by `kind_of`."""

    allowed: str
    """What is allowed, as it stands after "must be"."""

    def take(self, value: Any) -> Any:
        """The value in the form that functions work with: an `int` for any whole number, an array
        for nested lists of numbers, most others as they are.

        **Raises:** `Misfit` where it is not allowed.
        """
        raise NotImplementedError

    def __repr__(self) -> str:
        return self.allowed  # (as `help` shows it)

    def refused(self, value: Any) -> Misfit:
        return Misfit(lambda: f"must be {self.allowed}, not {show(value)}")
