"""Measurements in processes of their own, on more than one core."""

import json
import os
import pathlib
import subprocess
import sys
from typing import Any


def call(module: str, *arguments: str, **environment: str) -> Any:
    """Run a module of this folder as a script, and read what it prints last, as JSON."""
    here = pathlib.Path(__file__).parents[1]
    # The same hybridjax as in this process.
    path = os.pathsep.join([str(here), *(x for x in sys.path if x)])
    done = subprocess.run(
        (sys.executable, "-m", f"cases.{module}", *arguments),
        # Programs from the cache make XLA print pages about features of the processor.
        env=os.environ
        | environment
        | {"PYTHONPATH": path, "TF_CPP_MIN_LOG_LEVEL": "3"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])
