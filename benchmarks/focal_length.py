"""Errors with a wrong focal length.

The test of `python -m benchmarks.ub_people` (persons s7 and s8 of UTD-MHAD, head, neck and hands with
3 px noise), tracked with a camera whose focal length is so many times the true one. A camera that is
not calibrated is usually within 0.85 to 1.2.

    python -m benchmarks.focal_length --data DIR [--prior OUT/prior-....safetensors]

`--prior` takes the prior that the protocol fitted to s1 to s6 and left in its output folder. Without
it the shipped prior is used, which has seen s7 and s8: then the table says so, and only the
differences between its rows mean something.
"""

from pathlib import Path

import torch

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, save_text
from benchmarks._upper_body import score
from benchmarks.ub_people import TEST_PERSONS, people, still_and_moving
from torchpose.camera import PinholeCamera
from torchpose.errors import OverlapError
from torchpose.evaluation._trials import Trials, track
from torchpose.priors import UpperBodyPrior, load_prior

FOCAL, CENTRE = 525.0, (319.5, 239.5)  # of the test camera
FACTORS = (0.7, 0.85, 1.0, 1.2, 1.4)
TRACKERS = {
    "as it comes": {},
    "smoothed": {"smoothing": "full"},
    "single poses": {"method": "mkf-fixed"},
}
HEADER = ("tracker", "f / true f", "3D error (cm)", "moving root (cm)", "pixel error")


def main(
    *,
    data: Path,
    prior: str = "kinect-upper-body",
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
) -> None:
    """Print the table.

    Args:
        data: folder with kinect_utd_mhad/.
        prior: name or file; best of others than the test persons.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: a few sequences, to see that it works.
    """
    torch.set_num_threads(threads)
    fitted = load_prior(prior)
    _, tested = people(data, quick)
    tested = tested[:: 3 if quick else 1]
    still, moving = still_and_moving(tested)
    lines = [f"| {' | '.join(HEADER)} |", f"|{' --- |' * len(HEADER)}"]
    trackers = dict(list(TRACKERS.items())[: 1 if quick else None])
    for name, options in trackers.items():
        for factor in FACTORS[: 3 if quick else None]:
            row = [name, f"{factor:g}", *errors(fitted, still, moving, factor, options)]
            lines.append(f"| {' | '.join(row)} |")
    text = "\n".join([*lines, "", f"{note(fitted, {r.person_id for r in tested})}\n"])
    print(text, end="")
    save_text(out, text)


def errors(
    prior: UpperBodyPrior, still: Trials, moving: Trials, factor: float, options: dict[str, object]
) -> list[str]:
    """Return the mean 3D errors of both tests after fixed-scale Procrustes, and the first's pixel error."""
    focal = factor * FOCAL
    camera = PinholeCamera(focal, focal, *CENTRE, 640, 480)
    first, second = (score(track(prior, camera, test, **options), test) for test in (still, moving))
    numbers = (first.mean_error, second.mean_error, float(first.errors2d.nanmean()))
    return [f"{number:.2f}" for number in numbers]


def note(prior: UpperBodyPrior, persons: set[str]) -> str:
    """Return a sentence that names the prior and says whether it has seen the test persons."""
    name = prior.info.name or "unnamed"
    try:
        prior.check_unseen(persons)
    except OverlapError:
        return (
            f"Prior {name}, which HAS SEEN {' and '.join(TEST_PERSONS)}: the errors are too small, "
            "only their differences count."
        )
    return f"Prior {name}, which has not seen {' and '.join(TEST_PERSONS)}."


if __name__ == "__main__":
    run_command(main)
