"""`torchpose fit manifold|limbs|actions|body`: what body trackers learn from recordings of whole bodies."""

import shlex
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose._core.terminal import show_progress, without_options
from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible
from torchpose.cli._options import Option, options_of
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torchpose.io._results import ResultsFolder

_EXAMPLES = {
    "manifold": "torchpose fit manifold walks/ --out walk.safetensors --persons anna ben --held-out carl\n"
    "torchpose fit manifold walks/ --out anna.safetensors --persons anna --validation 2",
    "limbs": "torchpose fit limbs walks/ --out limbs.safetensors --held-out carl\n"
    "torchpose fit limbs recordings/ --out bends.safetensors --actions bend --fps 30",
    "actions": "torchpose fit actions recordings/ --actions bend --out bend.safetensors --held-out carl\n"
    "torchpose fit actions recordings/ --actions bend wave clap --out bank.safetensors",
    "body": "torchpose fit body recordings/ --out body.safetensors --held-out carl\n"
    "torchpose fit body walks/ exercises/ --out body.safetensors --acceleration-scale 1.5",
}
KINDS = tuple(_EXAMPLES)
"""What there is to fit, beside priors of the upper body."""

PYTHON_ONLY = frozenset({"gamma_x", "optimiser", "learning_rate"})
"""Settings of recipes that only Python and the training loop have."""

_Parts = tuple[Callable[..., int], tuple[Option, ...], tuple[Option, ...]]
"""What fits, and its options: those that choose recordings, and those of the recipe."""

_OF_BANKS = ("stay", "spread", "background", "evidence_rate", "gate_dimensions")
_WORDS = ("persons", "held_out", "actions", "without")


def main(kind: str, arguments: list[str]) -> int:
    """Fit one of `KINDS` and return the exit code."""
    return command(kind).main(arguments)


def command(kind: str) -> Command:
    """Return the command that fits one of `KINDS`."""
    run, gather, recipe = _FITS[kind]()
    return Command(
        f"fit {kind}",
        run,
        _EXAMPLES[kind],
        {"choice": gather, "recipe": recipe},
        spaced=("recordings",),
        metavars={"out": "FILE", "postures": "body|joints"},
    )


def recorded_command(given: Given) -> str:
    """Return the command as the model's file says it."""
    if given.values["config"]:
        typed = without_options(given.typed, ("--out", "--pictures"))
        return shlex.join(["torchpose", *given.words, *typed])
    return given.line(Path(given.values["out"]).name)


@contextmanager
def _results(
    given: Given, pictures: bool
) -> "Iterator[tuple[ResultsFolder, Path, dict[str, str]]]":
    """Return the folder of the model, its file, and its name, licence and command; all in use."""
    from torchpose.learning._fit_files import check_fit_file, fit_results

    values = given.values
    out = check_fit_file(values["out"])
    facts = {"name": values["name"] or out.stem, "licence": values["licence"]}
    with fit_results(out, given.files(), pictures) as results:
        yield results, out, facts | {"command": recorded_command(given)}


def _print_notes(notes: Iterable[str]) -> None:
    """Print notes on recordings before what is fitted to them, which may take long."""
    for note in notes:
        print(f"note: {note}", flush=True)


def _gathered(gather: Callable[..., Any], *leave_out: str) -> tuple[Option, ...]:
    """Return the options that choose recordings, of a function that passes them to `choose_recordings`."""
    from torchpose.learning._recipes.choosing import choose_recordings

    return options_of(
        gather, ("paths", "progress", *leave_out), {"without": "without_files"}, _WORDS,
        refers_to=choose_recordings,
    )  # fmt: skip


# --- manifolds ------------------------------------------------------------------------------------


def _manifold() -> _Parts:
    from torchpose.learning._recipes.manifold import ManifoldPoses, ManifoldRecipe

    return fit_manifold, _gathered(ManifoldPoses.gather), options_of(ManifoldRecipe, PYTHON_ONLY)


def fit_manifold(
    recordings: list[str],
    *,
    out: str,
    choice: dict[str, Any],
    recipe: dict[str, Any],
    name: str = "",
    licence: str = "",
    pictures: bool = True,
    given: Given,
) -> int:
    """Fit a manifold of one motion, a back-constrained GPLVM.

    It is for the manifold-regularised body tracker (track-body --manifold). A fit that was stopped goes on
    when it is started again.

    Args:
        recordings: folders (with their subfolders) or files of whole bodies; $NAME stands for a variable
            of the environment.
        out: the model, NAME.safetensors.
        choice: arguments of `ManifoldPoses.gather`. recipe: of `ManifoldRecipe`.
        name: name in the model's metadata (default that of the file).
        licence: licence of the recordings.
        pictures: draw it. given: the command.
    """
    from torchpose.learning._fit_files import write_manifold_files
    from torchpose.learning._recipes.manifold import (
        ManifoldFitting,
        ManifoldPoses,
        ManifoldRecipe,
        run_to_end,
        taken_up,
    )

    if choice["held_out"]:
        given.refuse(("validation",), "fits without persons held out, and --held-out names some")
    with _results(given, pictures) as (results, file, facts):
        settings, pictures = ManifoldRecipe(**recipe), pictures_possible(pictures)
        poses = ManifoldPoses.gather(recordings, **choice, progress=show_progress())
        _print_notes(poses.notes)
        fitting = ManifoldFitting(poses, settings)
        kept = file.with_name(f"{file.name}.partial")
        taken = taken_up(fitting, kept)
        if taken:
            print(f"going on after {taken} steps, from {kept}", flush=True)
        run_to_end(fitting, kept, show_progress())
        print(write_manifold_files(fitting, results, file.name, pictures, **facts))
        kept.unlink(missing_ok=True)
    return 0


# --- limbs ----------------------------------------------------------------------------------------


def _limbs() -> _Parts:
    from torchpose.learning._recipes.limbs import LimbStates
    from torchpose.learning._recipes.limbs import fit_limbs as recipe

    return fit_limbs, _gathered(LimbStates.gather), options_of(recipe)


def fit_limbs(
    recordings: list[str],
    *,
    out: str,
    choice: dict[str, Any],
    recipe: dict[str, float],
    name: str = "",
    licence: str = "",
    given: Given,
) -> int:
    """Fit limb conditionals, how limbs stand to each other and how fast they turn.

    They are for the body tracker with root hypotheses (track-body --conditionals).

    Args:
        recordings: folders (with their subfolders) or files of whole bodies; $NAME stands for a variable
            of the environment.
        out: the model, NAME.safetensors.
        choice: arguments of `LimbStates.gather`. recipe: of `fit_limbs`.
        name: name in the model's metadata (default that of the file).
        licence: licence of the recordings.
        given: the command.
    """
    from torchpose.learning._fit_files import write_body_model
    from torchpose.learning._recipes import limbs

    with _results(given, False) as (results, file, facts):
        limbs.check_least_std(recipe["least_std"])
        states = limbs.LimbStates.gather(recordings, **choice)
        _print_notes(states.notes)
        found, held_out = limbs.fit_limbs(states, recipe["least_std"], **facts)
        print(write_body_model(found, limbs.limb_summary(found, held_out), results, file.name))
    return 0


# --- actions --------------------------------------------------------------------------------------


def _actions() -> _Parts:
    from torchpose.learning._recipes.actions import ActionRecipe, Performances

    return fit_actions, _gathered(Performances.gather, "postures"), options_of(ActionRecipe)


def fit_actions(
    recordings: list[str],
    *,
    out: str,
    choice: dict[str, Any],
    postures: str = "body",
    recipe: dict[str, Any],
    name: str = "",
    licence: str = "",
    pictures: bool = True,
    given: Given,
) -> int:
    """Fit the postures of an action, or a bank of several actions.

    They are for the constrained body tracker (track-body --action).

    Args:
        recordings: folders (with their subfolders) or files of whole bodies; $NAME stands for a variable
            of the environment.
        out: the model, NAME.safetensors.
        choice: arguments of `Performances.gather`.
        postures: on a body of average proportions, which is what the tracker takes ("body", default), or
            between the recorded joints ("joints").
        recipe: of `ActionRecipe`.
        name: name in the model's metadata (default that of the file).
        licence: licence of the recordings.
        pictures: draw it. given: the command.
    """
    from torchpose.learning._fit_files import write_action_files
    from torchpose.learning._recipes import actions

    if len(set(choice["actions"])) == 1:
        given.refuse(_OF_BANKS, "a bank of several actions, and there is one")
    with _results(given, pictures) as (results, file, facts):
        if postures not in ("body", "joints"):
            raise InputError(f"--postures must be body or joints, got {postures!r}")
        settings, pictures = actions.ActionRecipe(**recipe), pictures_possible(pictures)
        performances = actions.Performances.gather(recordings, **choice, postures=postures)  # type: ignore[arg-type]
        _print_notes(performances.notes)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            fitted = actions.fit_actions(performances, settings)
        _print_notes(str(one.message) for one in said)
        print(write_action_files(fitted, results, file.name, pictures, **facts))
    return 0


# --- how bodies move ------------------------------------------------------------------------------


def _body() -> _Parts:
    from torchpose.learning._body_motion_fit import BodyMotionRecipe
    from torchpose.learning._recipes.body_motion import RecordedMotion

    return fit_body_motion, _gathered(RecordedMotion.gather), options_of(BodyMotionRecipe)


def fit_body_motion(
    recordings: list[str],
    *,
    out: str,
    choice: dict[str, Any],
    recipe: dict[str, Any],
    name: str = "",
    licence: str = "",
    given: Given,
) -> int:
    """Fit how bodies move, which poses they take and how they are built.

    It is for the filter that tracks whole bodies from keypoints.

    Args:
        recordings: folders (with their subfolders) or files of whole bodies; $NAME stands for a variable
            of the environment.
        out: the model, NAME.safetensors.
        choice: arguments of `RecordedMotion.gather`. recipe: of `BodyMotionRecipe`.
        name: name in the model's metadata (default that of the file).
        licence: licence of the recordings.
        given: the command.
    """
    from torchpose.learning._body_motion_fit import BodyMotionRecipe
    from torchpose.learning._fit_files import write_body_model
    from torchpose.learning._recipes.body_motion import (
        RecordedMotion,
        fit_motion,
        motion_summary,
    )

    with _results(given, False) as (results, file, facts):
        settings = BodyMotionRecipe(**recipe)
        recorded = RecordedMotion.gather(recordings, **choice, progress=show_progress())
        _print_notes(recorded.notes)
        found, held_out = fit_motion(recorded, settings, **facts)
        print(write_body_model(found, motion_summary(found, held_out), results, file.name))
    return 0


_FITS = {"manifold": _manifold, "limbs": _limbs, "actions": _actions, "body": _body}
