"""Where benchmarks put their numbers: on the screen, line by line, and in a table by name."""

import datetime
import importlib.metadata
import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from typing import Any


Show = Callable[[str, Any], None]
PACKAGES = (
    "hybridjax",
    "jax",
    "jaxlib",
    "equinox",
    "diffrax",
    "numpy",
    "scipy",
    "heyoka",
)


class Report:
    """Values by name. `report.under("grid")` gives `show(name, value)`, which prints
    `grid.name value` and keeps it."""

    def __init__(self):
        self.values: dict[str, Any] = {}

    def under(self, prefix: str) -> Show:
        def show(name: str, value: Any) -> None:
            if hasattr(value, "item"):
                value = value.item()
            self.values[f"{prefix}.{name}"] = value
            text = f"{value:.3g}" if isinstance(value, float) else value
            print(f"{prefix}.{name} {text}", flush=True)

        return show


def hardware() -> dict[str, Any]:
    return {
        "cpu": _processor(),
        "cores": _cores(),
        "system": platform.platform(terse=True),
    }


def software() -> dict[str, str]:
    """Versions of what takes part and is installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            pass
    if shutil.which("gcc"):
        out = subprocess.run(
            ("gcc", "-dumpfullversion"), capture_output=True, text=True
        )
        found["gcc"] = out.stdout.strip()
    return found


def today() -> str:
    return datetime.date.today().isoformat()


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(
                x.split(":")[1].strip() for x in file if x.startswith("model name")
            )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
