"""`torchpose fit manifold|limbs|actions`: what the body trackers learn, from recordings of whole bodies."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from torchpose._core.terminal import show_progress
from torchpose.cli.common import add_seed, command_line, input_files, new_parser, pictures_possible
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torchpose.io._results import ResultsFolder

__all__ = ["KINDS", "build", "main"]

_TEXT = {
    "manifold": "Fit a manifold of one motion, a back-constrained GPLVM, for the manifold-regularised body "
    "tracker (track-body --manifold). A fit that was stopped goes on when it is started again.",
    "limbs": "Fit limb conditionals, how limbs stand to each other and how fast they turn, for the body "
    "tracker with root hypotheses (track-body --conditionals).",
    "actions": "Fit the postures of an action, or a bank of several actions, for the constrained body "
    "tracker (track-body --action).",
}
KINDS = tuple(_TEXT)
"""What there is to fit, beside priors of the upper body."""

_EXAMPLES = {
    "manifold": "torchpose fit manifold walks/ --out walk.safetensors --persons anna ben --held-out carl\n"
    "torchpose fit manifold walks/ --out anna.safetensors --persons anna --validation 2",
    "limbs": "torchpose fit limbs walks/ --out limbs.safetensors --held-out carl\n"
    "torchpose fit limbs recordings/ --out bends.safetensors --actions bend --fps 30",
    "actions": "torchpose fit actions recordings/ --actions bend --out bend.safetensors --held-out carl\n"
    "torchpose fit actions recordings/ --actions bend wave clap --out bank.safetensors",
}
_FPS = {"manifold": 60.0, "limbs": 60.0, "actions": 30.0}
_CHOICE = ("persons", "held_out", "actions", "axes", "fps")


def main(kind: str, arguments: list[str]) -> int:
    """Fit one of `KINDS` and return the exit code."""
    return run(kind, build(kind).parse_args(arguments))


def build(kind: str) -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(f"fit {kind}", _TEXT[kind], _EXAMPLES[kind])
    add = parser.add_argument
    add("recordings", nargs="+", type=str, metavar="DIR",
        help="folders (with their subfolders) or files of whole bodies; $NAME stands for a variable of "
        "the environment")  # fmt: skip
    add("--out", type=str, required=True, metavar="FILE", help="the model, NAME.safetensors")
    add("--persons", type=str, nargs="+", metavar="PERSON",
        help="whom to fit to (default everybody who is not held out)")  # fmt: skip
    add("--held-out", type=str, nargs="+", metavar="PERSON",
        help="persons who are not fitted to: they tell how good the model is on others, and a manifold's "
        "noise")  # fmt: skip
    add("--actions", type=str, nargs="+", metavar="ACTION", required=kind == "actions",
        help="names of actions, as the files give them"
        + ("; several give a bank" if kind == "actions" else " (default all)"))  # fmt: skip
    add("--without-files", type=str, nargs="+", metavar="NAME",
        help="names of files, without their suffix, to leave out altogether")  # fmt: skip
    add("--fps", type=float, default=_FPS[kind], metavar="HZ",
        help=f"frame rate of what is fitted, best that of the videos (default {_FPS[kind]:g})")  # fmt: skip
    add("--axes", type=str, metavar="AXES",
        help="of all recordings: camera, kinect, y-up, z-up; by default what each file says")  # fmt: skip
    _OWN[kind](parser)
    add("--name", type=str, default="", metavar="NAME",
        help="name in the model's metadata (default that of the file)")  # fmt: skip
    add("--licence", type=str, default="", metavar="TEXT", help="licence of the recordings")
    if kind != "limbs":
        add("--pictures", type=bool, default=True, metavar="true|false",
            help="draw it (default true)")  # fmt: skip
    return parser


def run(kind: str, args: Namespace) -> int:
    """Read, fit, write and report; every check of an option comes before any work."""
    from torchpose.io._formats.axes import AXES
    from torchpose.learning._fit_files import check_fit_file, fit_results

    if args.axes is not None and args.axes not in AXES:
        raise InputError(f"--axes must be one of {', '.join(AXES)}, got {args.axes!r}")
    out = check_fit_file(args.out)
    facts = {"name": args.name or out.stem, "licence": args.licence}
    facts |= {"command": recorded_command(kind, args)}
    with fit_results(out, input_files(args), getattr(args, "pictures", False)) as results:
        print(_FITS[kind](args, results, out, facts))
    return 0


def recorded_command(kind: str, args: Namespace) -> str:
    """Return the command as the model's file says it."""
    if args.config:
        return shlex.join(["torchpose", "fit", kind, "--config", *map(str, args.config)])
    return command_line(("fit", kind), args, build(kind).get_defaults(), Path(args.out).name)


# --- manifolds ------------------------------------------------------------------------------------


def _manifold_options(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--validation", type=int, default=2, metavar="N",
        help="without --held-out, recordings of each person that are held out, the last ones by name "
        "(default 2)")  # fmt: skip
    add("--frames", type=int, default=350, metavar="N",
        help="that are fitted to at most, spread over all recordings (default 350); time grows with their "
        "cube")  # fmt: skip
    add("--latent-dim", type=int, default=2, metavar="N", help="dimensions (default 2)")
    add("--steps", type=int, default=40, metavar="N",
        help="of ten iterations of the optimiser, at most (default 40)")  # fmt: skip
    add("--patience", type=int, default=3, metavar="N",
        help="steps without a better error on what is held out, after which it ends (default 3)")  # fmt: skip
    add("--start", type=int, default=0, metavar="N",
        help="which principal components to start from, 0 the first ones (default 0)")  # fmt: skip
    add("--smoothness", type=float, default=0.0, metavar="X",
        help="of the back constraints; 0 is the published form (default 0)")  # fmt: skip
    add("--standardise", type=bool, default=False, metavar="true|false",
        help="let all columns weigh the same (default false)")  # fmt: skip
    add_seed(parser, "the frames that tell the scale of distances, where there are very many")


def _fit_manifold(
    args: Namespace, results: "ResultsFolder", out: Path, facts: dict[str, str]
) -> str:
    from torchpose.learning._fit_files import write_manifold_files
    from torchpose.learning._recipes.manifold import (
        ManifoldFitting,
        ManifoldPoses,
        ManifoldRecipe,
        run_to_end,
        taken_up,
    )

    names = ("latent_dim", "steps", "patience", "start", "smoothness", "standardise", "seed")
    recipe = ManifoldRecipe(**{name: getattr(args, name) for name in names})
    pictures = pictures_possible(args.pictures)
    poses = ManifoldPoses.gather(
        args.recordings, validation=args.validation, frames=args.frames, without=args.without_files,
        progress=show_progress(), **_chosen(args),
    )  # fmt: skip
    fitting = ManifoldFitting(poses, recipe)
    kept = out.with_name(f"{out.name}.partial")
    taken = taken_up(fitting, kept)
    if taken:
        print(f"going on after {taken} steps, from {kept}", flush=True)
    run_to_end(fitting, kept, show_progress())
    return write_manifold_files(fitting, results, out.name, pictures, **facts)


# --- limbs ----------------------------------------------------------------------------------------


def _limb_options(parser: ArgumentParser) -> None:
    parser.add_argument("--least-std", type=float, default=0.01, metavar="X",
        help="least deviation of a limb in any direction, sine of half an angle (default 0.01)")  # fmt: skip


def _fit_limbs(args: Namespace, results: "ResultsFolder", out: Path, facts: dict[str, str]) -> str:
    from torchpose.learning._fit_files import write_limb_files
    from torchpose.learning._recipes.limbs import LimbStates, check_least_std

    check_least_std(args.least_std)
    states = LimbStates.gather(args.recordings, without=args.without_files, **_chosen(args))
    return write_limb_files(states, results, out.name, args.least_std, **facts)


# --- actions --------------------------------------------------------------------------------------


def _action_options(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--repeated", type=bool, default=True, metavar="true|false",
        help="cut recordings into repetitions (default true)")  # fmt: skip
    add("--postures", type=str, default="body", metavar="body|joints",
        help="on a body of average proportions, which is what the tracker takes (default), or between "
        "the recorded joints")  # fmt: skip
    add("--n-dimensions", type=int, default=13, metavar="N",
        help="of the principal axes of the postures (default 13)")  # fmt: skip
    add("--n-postures", type=int, metavar="N",
        help="of the mean performance (default the median length)")  # fmt: skip
    add("--prominence", type=float, default=0.15, metavar="X",
        help="of a key frame, share of the range of distances to the mean (default 0.15)")  # fmt: skip
    for name, text in (
        ("stay", "probability that somebody does the same thing a second later (default 0.8)"),
        ("spread", "factor on the deviations, for persons it has not seen (default 1)"),
        ("background", "factor on the deviation of everything, for none of them (default 1)"),
        ("evidence-rate", "frames per second that count as independent (default 1)"),
    ):
        default = 0.8 if name == "stay" else 1.0
        add(f"--{name}", type=float, default=default, metavar="X", help=f"of a bank: {text}")
    add("--gate-dimensions", type=int, metavar="N",
        help="of a bank: how many of the dimensions its gates look at (default all); 25 dimensions and 13 "
        "here tell actions apart best")  # fmt: skip
    add_seed(parser, "the trial of the gate")


def _fit_actions(
    args: Namespace, results: "ResultsFolder", out: Path, facts: dict[str, str]
) -> str:
    from torchpose.learning._fit_files import write_action_files
    from torchpose.learning._recipes.actions import ActionRecipe, Performances, fit_actions

    names = ("n_dimensions", "n_postures", "prominence", "stay", "spread", "background",
             "evidence_rate", "gate_dimensions", "seed")  # fmt: skip
    recipe = ActionRecipe(**{name: getattr(args, name) for name in names})
    if args.postures not in ("body", "joints"):
        raise InputError(f"--postures must be body or joints, got {args.postures!r}")
    pictures = pictures_possible(args.pictures)
    performances = Performances.gather(
        args.recordings, without=args.without_files, repeated=args.repeated,
        postures=args.postures, **_chosen(args),
    )  # fmt: skip
    fitted = fit_actions(performances, recipe)
    return write_action_files(fitted, results, out.name, pictures, **facts)


def _chosen(args: Namespace) -> dict[str, Any]:
    """What all kinds choose recordings by."""
    return {name: getattr(args, name) for name in _CHOICE}


_OWN = {"manifold": _manifold_options, "limbs": _limb_options, "actions": _action_options}
_FITS = {"manifold": _fit_manifold, "limbs": _fit_limbs, "actions": _fit_actions}
