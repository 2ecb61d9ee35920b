"""The recipe of docs/how-to/scale.md on a Slurm that `benchmarks/slurm.sh` has started."""

import os
import tempfile
import time

import numpy as np
from dask.distributed import Client
from dask_jobqueue import SLURMCluster

import hybridjax as hj


def main() -> None:
    hj.enable_x64()
    over = {"slope": np.linspace(0.075, 0.09, 10), "spokes": np.linspace(8, 9, 10)}
    kept = [
        f"export {name}={os.environ[name]}"
        for name in ("HYBRIDJAX_CACHE", "PYTHONPATH")
        if name in os.environ
    ]
    begin = time.perf_counter()
    with (
        tempfile.TemporaryDirectory() as folder,
        SLURMCluster(
            cores=1,
            processes=1,
            memory="2GB",
            walltime="00:20:00",
            job_script_prologue=kept,
            log_directory=folder,
            scheduler_options={"dashboard_address": ":0"},
        ) as cluster,
    ):
        cluster.scale(jobs=2)
        with Client(cluster) as client:
            client.wait_for_workers(2, timeout=300)
            wheels = hj.models.RimlessWheel()
            found = hj.sweep(
                wheels, over, chunk=10, store=f"{folder}/map.zarr", client=client
            )
            found.load()
    error = np.abs(found.spectral_radius - np.cos(2 * np.pi / found.spokes) ** 2).max()
    print(f"slurm.points {found.result.size}")
    print(f"slurm.failed {int((found.result != 0).sum())}")
    print(f"slurm.error {float(error):.1e}")
    print(f"slurm.seconds {time.perf_counter() - begin:.3g}")


if __name__ == "__main__":
    main()
