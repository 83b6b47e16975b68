"""`torchpose fit`: a prior from recordings of 3D joints."""

import inspect
import shlex
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import (
    add_seed,
    new_parser,
    pictures_possible,
    save_pictures,
    show_progress,
)
from torchpose.errors import InputError, OutputError

if TYPE_CHECKING:
    from torchpose.io import Recording
    from torchpose.priors import UpperBodyPrior

_EXAMPLES = """
torchpose fit recordings/ --out prior.safetensors
torchpose fit recordings/ more/ clip.npz --out prior.safetensors --components 30 --seed 0 --name mine
torchpose fit recordings/ --out prior.safetensors --noise none --samples 20000
torchpose fit room/ --out prior.safetensors --axes z-up"""

_SHOWN_PATHS = 8
_RECIPES = {
    "learnt": ("torchpose.recipes", "fit_kinect_prior"),
    "none": ("torchpose.priors", "fit_upper_body_prior"),
}


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "fit",
        "Fit a prior of the upper body to recorded 3D poses seen from random viewpoints, and learn "
        "the noise of its filters. Writes the prior, a model card beside it (.md) and a picture of "
        "its mean poses (.png).",
        _EXAMPLES,
    )
    add = parser.add_argument
    add(
        "recordings",
        nargs="+",
        type=str,
        metavar="DIR",
        help="folders (with their subfolders) or files: .npz, OpenCV .yaml, Kinect v2 .csv",
    )
    add("--out", type=str, required=True, metavar="FILE", help="the prior, NAME.safetensors")
    add("--components", type=int, default=30, metavar="K", help="Gaussians per arm (default 30)")
    add_seed(parser, "viewpoints and start")
    add(
        "--axes",
        type=str,
        metavar="AXES",
        help="axes of all recordings: camera, kinect, y-up, z-up; by default what each file says, "
        "else what its joint set usually has",
    )
    add(
        "--name",
        type=str,
        default="",
        metavar="NAME",
        help="name in the prior's metadata (default that of the file)",
    )
    add("--licence", type=str, default="", metavar="TEXT", help="licence of the recordings")
    add(
        "--noise",
        type=str,
        default="learnt",
        metavar="learnt|none",
        help="learn process and measurement noise and calibrate the covariances (default), or leave "
        "them to the tracker's defaults",
    )
    add(
        "--neck",
        type=str,
        metavar="KIND",
        help="kind of neck to convert to: neck, low-neck, mid-shoulder (default the highest there is)",
    )
    add("--samples", type=int, metavar="N", help="training states per arm (default 100000)")
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw the mean poses (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Read, fit, write and report; every check comes before any work."""
    from torchpose.io import AXES, check_output_folder, find_recordings, read_recordings
    from torchpose.priors import write_model_card
    from torchpose.skeleton import NECK_KINDS

    for option, value, known in (
        ("--axes", args.axes, AXES),
        ("--neck", args.neck, NECK_KINDS),
        ("--noise", args.noise, tuple(_RECIPES)),
    ):
        if value is not None and value not in known:
            raise InputError(f"{option} must be one of {', '.join(known)}, got {value!r}")
    for option, count in (("--components", args.components), ("--samples", args.samples)):
        if count is not None and count < 1:
            raise InputError(f"{option} must be at least 1, got {count}")
    out = _output_file(args.out)
    files = find_recordings(args.recordings)
    recordings = read_recordings(files, args.axes)
    pictures = pictures_possible(args.pictures)
    check_output_folder(out.parent)
    print(f"read     {_count(recordings)}", flush=True)
    prior = _fit(recordings, args, args.name or out.stem)
    prior.info = replace(prior.info, command=prior.info.command or command_line(args))
    prior.save(out)
    write_model_card(prior, out.with_suffix(".md"))
    written = [out, out.with_suffix(".md")]
    if pictures:
        from torchpose import viz

        arms = {"left arm": prior.left, "right arm": prior.right}
        picture = out.with_suffix(".png").name
        written += save_pictures(out.parent, {picture: lambda: viz.plot_prior_means(arms)})
    print(summary(prior, written))
    return 0


def summary(prior: "UpperBodyPrior", written: list[Path]) -> str:
    """A few lines for people: what was fitted, on what, which files."""
    info = prior.info
    lines = [
        f"prior    {info.name}, {prior.n_components} components per arm, neck: {info.neck}, "
        f"hand: {info.hand}",
        f"persons  {len(info.persons)}",
        f"states   {info.n_samples} per arm from {info.n_frames} recorded frames",
    ]
    fit = info.extra.get("fit")
    if fit:
        end = "" if fit["converged"] else ", not converged"
        lines.append(
            f"EM       mean log-likelihood {fit['log_likelihood']:.4f} after {fit['iterations']} "
            f"iterations{end}"
        )
    lines.append(f"noise    {', '.join(prior.noise) or 'not learnt'}")
    return "\n".join([*lines, *(f"wrote    {path}" for path in written)])


def _fit(recordings: list["Recording"], args: Namespace, name: str) -> "UpperBodyPrior":
    home, function = _RECIPES[args.noise]
    fit = getattr(import_module(home), function)
    options = {"neck": args.neck, "n_samples": args.samples, "licence": args.licence or None}
    given = {key: value for key, value in options.items() if value is not None}
    parameters = inspect.signature(fit).parameters
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    refused = [key for key in given if key not in parameters and not takes_any]
    if refused == ["licence"]:
        del given["licence"]
    elif refused:
        raise InputError(
            f"--{refused[0].removeprefix('n_')} applies only with --noise none: the recipe that "
            "learns the noise sets it itself"
        )
    prior = fit(
        recordings,
        n_components=args.components,
        seed=args.seed,
        name=name,
        progress=show_progress(),
        **given,
    )
    if args.licence:
        prior.info = replace(prior.info, licence=args.licence)
    return prior


def _output_file(name: str) -> Path:
    out = Path(name)
    if out.suffix != ".safetensors":
        raise OutputError(f"{out}: expected a name that ends in .safetensors")
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give the name of a file")
    return out


def command_line(args: Namespace) -> str:
    """The command with every option that differs from what it is by default, many paths cut short."""
    paths = list(args.recordings)
    if len(paths) > _SHOWN_PATHS:
        paths = [*paths[:1], f"...{len(paths) - 1} more"]
    parts = ["torchpose", "fit", *paths, "--out", args.out]
    defaults = build().get_defaults()
    for key, value in vars(args).items():
        if key in ("recordings", "out", "config", "pictures") or value == defaults.get(key):
            continue
        parts += [f"--{key.replace('_', '-')}", str(value)]
    return shlex.join(parts)


def _count(recordings: list["Recording"]) -> str:
    persons = len({r.person_id for r in recordings})
    frames = sum(len(r) for r in recordings)
    return f"{len(recordings)} recordings of {persons} persons, {frames} frames"
