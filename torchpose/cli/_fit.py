"""`torchpose fit`: a prior from recordings of 3D joints; what body trackers learn by a word of its own."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from torchpose._core.terminal import show_progress
from torchpose._core.wording import counted
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible
from torchpose.cli._fit_bodies import KINDS
from torchpose.cli._fit_bodies import main as fit_bodies
from torchpose.cli._options import options_of
from torchpose.errors import InputError
from torchpose.io._formats.axes import Axes

if TYPE_CHECKING:
    from torchpose.io._recordings import Recording
    from torchpose.priors._upper_body_prior import UpperBodyPrior

_EXAMPLES = """
torchpose fit recordings/ --out prior.safetensors
torchpose fit recordings/ more/ clip.npz --out prior.safetensors --components 30 --seed 0 --name mine
torchpose fit recordings/ --out prior.safetensors --without bob carol
torchpose fit recordings/ --out prior.safetensors --noise none --samples 20000
torchpose fit room/ --out prior.safetensors --axes z-up --harmonise true
torchpose fit recordings/ --out renewed.safetensors --noise-of prior.safetensors
torchpose fit manifold --help
torchpose fit limbs --help
torchpose fit actions --help
torchpose fit body --help"""

_SHOWN_DROPS = 5
_KEYS = {"n_components": "components", "calibration_folds": "folds"}
_AT_LEAST_ZERO = ("window_components", "folds", "drawn_pieces")
_OF_CALIBRATION = ("folds", "drawn_pieces")
_OF_MIXTURES = ("components", "samples", "seed", "neck", "window_components")
PYTHON_ONLY = frozenset({
    "n_samples", "pose_steps", "pose_tol", "window_samples", "window_steps", "body_size",
    "bone_lengths", "mirror_share", "camera_matrix", "rotation_order", "mirror", "nose_as_head",
})  # fmt: skip
"""Settings of the recipe that only Python and the training loop have; n_samples is `samples` of `run`."""


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    if arguments and arguments[0] in KINDS:
        return fit_bodies(arguments[0], arguments[1:])
    return command().main(arguments)


def command() -> Command:
    """Return the command."""
    from torchpose.learning._curation.curate import CurationSettings
    from torchpose.learning._recipes.upper_body import UpperBodyRecipe

    curation = [one for one in options_of(CurationSettings) if one.name == "harmonise"]
    return Command(
        "fit",
        run,
        _EXAMPLES,
        {"recipe": options_of(UpperBodyRecipe, PYTHON_ONLY, _KEYS), "curation": curation},
        spaced=("recordings", "without"),
        metavars={"out": "FILE"},
    )


def run(
    recordings: list[str],
    *,
    out: str,
    recipe: dict[str, Any],
    samples: int | None = None,
    axes: Axes | None = None,
    without: list[str] | None = None,
    curate: bool = True,
    curation: dict[str, Any],
    name: str = "",
    licence: str = "",
    noise: Literal["learnt", "none"] = "learnt",
    noise_of: str | None = None,
    pictures: bool = True,
    given: Given,
) -> int:
    """Fit a prior of the upper body to recorded 3D poses seen from random viewpoints.

    From persons held out in turn it learns how good the prior is on somebody new. Writes the prior, a model
    card beside it (.md) and a picture of its mean poses (.png). With the word manifold, limbs, actions or
    body before the recordings, what the trackers of whole bodies learn; see their own --help.

    Args:
        recordings: folders (with their subfolders) or files; a folder is a person where a file does not
            say whose it is. Kinect v1, v2 (.csv, .skeleton) and Azure, .npz, .bvh, .c3d, OpenCV .yaml.
        out: the prior, NAME.safetensors. It and its card hold names of persons and of folders, and the
            command: give patients codes.
        recipe: settings of `UpperBodyRecipe`.
        samples: training states per arm (default 100000).
        axes: axes of all recordings; by default what a file axes.txt in the folder says, else each file, else
            what its joint set usually has.
        without: persons to leave out, to test on later.
        curate: leave out what jumps or is no body, and say so.
        curation: settings of `CurationSettings`.
        name: name in the prior's metadata (default that of the file, or of the prior of noise_of).
        licence: licence of the recordings.
        noise: the whole recipe with its noise, windows and calibration (default), or mixtures over single
            poses alone.
        noise_of: keep the mixtures and windows of this prior, a name or a file, which was fitted to the
            same recordings, and learn its process noise and its calibration over single poses.
        pictures: draw the mean poses.
        given: the command.
    """
    from torchpose.io._recordings import (
        find_recordings,
        notes_on_unread_files,
        read_recordings,
    )
    from torchpose.learning._fit_files import check_fit_file, fit_results, write_prior_files

    _check_options(given)
    file = check_fit_file(out)
    found = find_recordings(recordings)
    everything = read_recordings(found, axes)
    unread = notes_on_unread_files(recordings, found)
    pictures = pictures_possible(pictures)
    kept, said, facts = _curated(
        _without_persons(everything, without or []), curation if curate else None
    )
    words = {"name": name or file.stem, "licence": licence, "command": given.line(out)}
    with fit_results(file, given.files(), pictures) as results:
        print(said, *(f"note     {n}" for n in unread), sep="\n", flush=True)
        if noise == "none":
            prior = _fit_mixtures(kept, recipe, samples, words)
        elif noise_of is not None:
            prior = _renew_noise(kept, recipe, noise_of, words | {"name": name})
        else:
            prior = _fit_recipe(kept, recipe, samples, words)
        prior.info = replace(prior.info, extra=prior.info.extra | facts)
        done = write_prior_files(prior, results, file.name, pictures)
    print(done)
    return 0


def _fit_mixtures(
    recordings: list["Recording"],
    recipe: dict[str, Any],
    samples: int | None,
    words: dict[str, Any],
) -> "UpperBodyPrior":
    """Return a prior of mixtures over single poses alone."""
    from torchpose.learning._upper_body_prior_fit import fit_upper_body_prior

    return fit_upper_body_prior(
        recordings, recipe["n_components"], recipe["seed"], neck=recipe["neck"], n_samples=samples,
        progress=show_progress(), **words,
    )  # fmt: skip


def _renew_noise(
    recordings: list["Recording"], recipe: dict[str, Any], before: str, words: dict[str, str]
) -> "UpperBodyPrior":
    """Return the prior of an earlier version with process noise and calibration learnt anew."""
    from torchpose.learning._recipes.earlier import renew_noise
    from torchpose.priors._upper_body_prior import load_prior

    return renew_noise(
        load_prior(before), recordings, calibration_folds=recipe["calibration_folds"],
        drawn_pieces=recipe["drawn_pieces"], progress=show_progress(), **words,
    )  # fmt: skip


def _fit_recipe(
    recordings: list["Recording"],
    recipe: dict[str, Any],
    samples: int | None,
    words: dict[str, str],
) -> "UpperBodyPrior":
    """Return a prior of the whole recipe."""
    from torchpose.learning._recipes.upper_body import UpperBodyRecipe

    settings = recipe | ({} if samples is None else {"n_samples": samples})
    return UpperBodyRecipe(**settings).fit(recordings, progress=show_progress(), **words)


def _curated(
    recordings: list["Recording"], settings: dict[str, Any] | None
) -> tuple[list["Recording"], str, dict[str, Any]]:
    """Return curated recordings, a description of the omissions, and facts about them for the card."""
    from torchpose.learning._curation.curate import CurationSettings, curate, notes_on_recordings

    if settings is None:
        notes = [f"note     {note}" for note in notes_on_recordings(recordings)]
        return recordings, "\n".join([f"read     {_counts(recordings)}", *notes]), {}

    curated = curate(recordings, CurationSettings(**settings))
    report = curated.report
    return curated.recordings, report.text(_SHOWN_DROPS), report.for_prior()


def _without_persons(recordings: list["Recording"], persons: list[str]) -> list["Recording"]:
    """Return the recordings of everybody else."""
    from torchpose.learning._curation.splits import pick_persons

    known = sorted({r.person_id for r in recordings})
    out = pick_persons(persons, known)
    if out == set(known):
        raise InputError(f"--without leaves nobody to fit to, of {', '.join(known)}; name fewer")
    return [r for r in recordings if r.person_id not in out]


def _check_options(given: Given) -> None:
    """Raise `InputError` for values out of range, and for options that exclude each other."""
    from torchpose._core.checks import check_choice
    from torchpose.skeleton._upper_body import NECK_KINDS

    values = given.values
    neck = values["neck"]
    if neck is not None:
        check_choice("--neck", neck, NECK_KINDS)
    for key in ("components", "samples", *_AT_LEAST_ZERO):
        count, least = values[key], int(key not in _AT_LEAST_ZERO)
        if count is not None and count < least:
            raise InputError(f"--{key.replace('_', '-')} must be at least {least}, got {count}")
    if values["noise"] == "none" and values["noise_of"]:
        raise InputError("--noise-of learns noise; leave --noise out")
    if values["noise"] == "none" and values["window_components"]:
        raise InputError("--window-components applies only with --noise learnt")
    if values["noise"] == "none":
        given.refuse(_OF_CALIBRATION, "the calibration, and --noise none does without")
    if not values["curate"]:
        given.refuse(
            ("harmonise",), "curated recordings, and --curate false takes them as they are"
        )
    if values["noise_of"]:
        given.refuse(_OF_MIXTURES, "new mixtures, and --noise-of keeps those of a prior")


def _counts(recordings: list["Recording"]) -> str:
    persons = len({r.person_id for r in recordings})
    frames = sum(len(r) for r in recordings)
    return (
        f"{counted(len(recordings), 'recording')} of {counted(persons, 'person')}, "
        f"{counted(frames, 'frame')}"
    )
