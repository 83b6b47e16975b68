"""Three small people to fit to, settings of a fit of seconds, and a process that dies in its midst."""

import os
import signal
from pathlib import Path
from typing import Any

import yaml
from lightning.pytorch import Callback

from tests.evaluation.recordings import write_people

PERSONS = ("s1", "s2", "s3")
FRAMES = 30  # each; curation wants more by default
RECIPE = {
    "n_components": 3,
    "n_samples": 9000,  # three blocks, the last one short
    "pose_steps": 5,
    "pose_tol": 0.0,
    "window_components": 0,
    "calibration_folds": 2,
    "drawn_pieces": 0,
}
WINDOWS = {
    "window_components": 2,
    "window_samples": 5000,
    "window_steps": 2,
    "calibration_folds": 0,
}


def write_recordings(folder: Path) -> Path:
    """Recordings of the three."""
    return write_people(folder, PERSONS, FRAMES, n_sequences=2)


def settings(recordings: Path, folder: Path, **recipe: Any) -> dict[str, Any]:
    """Configuration of a fit to the first two, with the third held out, into a folder."""
    data = {
        "paths": [str(recordings)],
        "recipe": RECIPE | recipe,
        "held_out": ["s3"],
        "curation": {"person_frames": FRAMES},
    }
    return {
        "data": {"class_path": "train.data.RecordingsDataModule", "init_args": data},
        "prior": {"out": str(folder / "p.safetensors"), "command": "python -m train fit"},
        "pictures": {"every": 0, "at_end": False},
        "trainer": {"default_root_dir": str(folder / "runs"), "accelerator": "cpu"},
    }


def write_settings(folder: Path, values: dict[str, Any]) -> Path:
    """The configuration as a file."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "fit.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


class Kill(Callback):
    """A signal, SIGKILL by default, in the middle of a step, after some blocks of it.

    Args:
        step: number of the step, from 0. rank: of the process. signum: of the signal.
    """

    def __init__(self, step: int, rank: int = 0, signum: int = int(signal.SIGKILL)) -> None:
        self.step, self.rank, self.signum = step, rank, signum

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if (trainer.current_epoch, trainer.global_rank) == (self.step, self.rank):
            batch.watchers.append(lambda: os.kill(os.getpid(), self.signum))
