"""Run `python -m train fit` on made-up recordings, and check what it refuses."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from train.cli import main

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def scene_of(home: Path, config: str, options: Mapping[str, Any], **more: Any) -> SimpleNamespace:
    """A folder for results, with the arguments of a fit and what tests know of it."""
    words = [str(part) for pair in options.items() for part in pair]
    arguments = ["fit", "--config", str(CONFIGS / config), *words]
    return SimpleNamespace(home=home, arguments=arguments, **more)


def run(scene: SimpleNamespace, name: str, *more: str) -> int:
    """The exit code of the fit that writes NAME.safetensors; later options stand for earlier ones."""
    out = ["--prior.out", str(scene.home / f"{name}.safetensors")]
    folder = ["--trainer.default_root_dir", str(scene.home / "runs" / name)]
    return main([*scene.arguments, *out, *folder, *more])


def check_refusals(scene: SimpleNamespace, capsys, *cases: tuple[list[str], str]) -> None:
    """Each of these options ends the fit in one line with its message, and nothing is written."""
    for more, message in cases:
        assert run(scene, "bad", *more) == 2, more
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1, error
    assert not (scene.home / "bad.safetensors").exists()


def rewrite(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """Write an .npz anew after a change of its arrays."""
    with np.load(path) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(path, **arrays)


def make_hole(arrays: dict[str, Any]) -> None:
    """Take a joint out of all frames of a recording but the first nine."""
    arrays["joints"][9:, 4] = np.nan
