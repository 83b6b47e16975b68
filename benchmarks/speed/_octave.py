"""The released tracker in Octave, where `octave` is installed."""

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.speed._released import Model

SCRIPT = Path(__file__).with_name("released_tracker.m")


def find_octave() -> str | None:
    """Return the path of octave-cli, else that of octave; None if neither is on the PATH."""
    return shutil.which("octave-cli") or shutil.which("octave")


def run_octave(
    program: str, model: Model, z: np.ndarray, epsilon: float, runs: int
) -> tuple[np.ndarray, list[float]]:
    """Filter z [T, Z] `runs` times; means [T, D], and the seconds of each run by Octave's own clock."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        flat = {
            key: np.concatenate(getattr(model, key)) for key in ("covariances", "matrix", "noise")
        }
        values = {
            "weights": model.weights, "means": model.means, "offset": model.offset,
            "measure": model.measure, "noise_z": model.measurement_cov, "z": z,
            "epsilon": np.array([epsilon]), "runs": np.array([runs]), **flat,
        }  # fmt: skip
        for key, value in values.items():
            np.savetxt(folder / f"{key}.txt", np.atleast_1d(value), fmt="%.17g")
        command = [program, "--quiet", "--no-window-system", str(SCRIPT), name]
        subprocess.run(command, check=True, capture_output=True, text=True)
        mean = np.loadtxt(folder / "mean.txt", ndmin=2)
        return mean, np.loadtxt(folder / "seconds.txt", ndmin=1).tolist()
