"""The command `hybridjax sweep`: a map of limit cycles over parameters of a user's system."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DefinitionError
from ..plot.look import save_and_close
from ..plot.over_parameters import sweep as plot_sweep
from ..scale.sweeps import sweep


def run(options: Any) -> int:
    """Sweep, draw the maps beside the store, and print a summary, from the options of the command.

    **Raises:** `DefinitionError` for a file without such a model, and in the cases of `sweep`.
    """
    values = {
        name: np.linspace(low, high, count) for name, low, high, count in options.values
    }
    if len(values) < len(options.values):
        raise DefinitionError(
            "a parameter has two axes: give each `--values` another name."
        )
    maps = sweep(_load(*options.model), values, options.quantities, store=options.out)
    print(maps)
    print(
        f"{int((maps.result == 0).sum())} of {maps.result.size} points have a limit cycle"
    )
    for name in options.quantities:
        if maps[name].dims == tuple(values) and len(values) <= 2:
            path = f"{Path(options.out).with_suffix('')}-{name}"
            print(*save_and_close(path, plot_sweep(maps, name), ("png",)))
    return 0


def _load(file: str, name: str) -> Any:
    """The system, class or function of this name in a Python file."""
    path = Path(file)
    if not path.is_file():
        raise DefinitionError(
            f"there is no file '{file}': give the model as FILE.py:NAME."
        )
    sys.path.insert(0, str(path.parent.resolve()))  # for its own imports
    module = importlib.import_module(path.stem)
    if Path(module.__file__ or "").resolve() != path.resolve():
        raise DefinitionError(
            f"another module is called '{path.stem}': rename '{file}'."
        )
    if not hasattr(module, name):
        raise DefinitionError(f"'{file}' has no '{name}'.")
    system = getattr(module, name)
    return system() if isinstance(system, type) else system
