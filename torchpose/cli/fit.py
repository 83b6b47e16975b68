"""`torchpose fit`: a prior from recordings of 3D joints; what body trackers learn by a word of its own."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from torchpose._core.terminal import show_progress
from torchpose.cli.common import add_seed, command_line, input_files, new_parser, pictures_possible
from torchpose.cli.fit_bodies import KINDS
from torchpose.cli.fit_bodies import main as fit_bodies
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torchpose.io._recordings import Recording
    from torchpose.priors._upper_body import UpperBodyPrior

_EXAMPLES = """
torchpose fit recordings/ --out prior.safetensors
torchpose fit recordings/ more/ clip.npz --out prior.safetensors --components 30 --seed 0 --name mine
torchpose fit recordings/ --out prior.safetensors --without bob carol
torchpose fit recordings/ --out prior.safetensors --noise none --samples 20000
torchpose fit room/ --out prior.safetensors --axes z-up --harmonise true
torchpose fit recordings/ --out renewed.safetensors --noise-of prior.safetensors
torchpose fit manifold --help
torchpose fit limbs --help
torchpose fit actions --help"""

_SHOWN_DROPS = 5
_NOISE = ("learnt", "none")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    if arguments and arguments[0] in KINDS:
        return fit_bodies(arguments[0], arguments[1:])
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "fit",
        "Fit a prior of the upper body to recorded 3D poses seen from random viewpoints, and learn "
        "from persons held out in turn how good it is on somebody new. Writes the prior, a model "
        "card beside it (.md) and a picture of its mean poses (.png). With the word manifold, limbs or "
        "actions before the recordings, what the trackers of whole bodies learn; see their own --help.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add(
        "recordings",
        nargs="+",
        type=str,
        metavar="DIR",
        help="folders (with their subfolders) or files; a folder is a person where a file does not "
        "say whose it is. Kinect v1, v2 (.csv, .skeleton) and Azure, .npz, .bvh, .c3d, OpenCV .yaml",
    )
    add("--out", type=str, required=True, metavar="FILE", help="the prior, NAME.safetensors")
    add("--components", type=int, default=30, metavar="K", help="Gaussians per arm (default 30)")
    add("--window-components", type=int, metavar="K",
        help="Gaussians per arm over windows of motion; 0 for none (default 8 times as many as over "
        "poses, fewer for short recordings)")  # fmt: skip
    add_seed(parser, "viewpoints and start")
    add(
        "--axes",
        type=str,
        metavar="AXES",
        help="axes of all recordings: camera, kinect, y-up, z-up; by default what each file says, "
        "else what its joint set usually has",
    )
    add("--without", type=str, nargs="+", metavar="PERSON",
        help="persons to leave out, to test on later")  # fmt: skip
    add("--curate", type=bool, default=True, metavar="true|false",
        help="leave out what jumps or is no body, and say so (default true)")  # fmt: skip
    add("--harmonise", type=bool, default=False, metavar="true|false",
        help="give everybody the bones of the mean person (default false)")  # fmt: skip
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
        help="the whole recipe with its noise, windows and calibration (default), or mixtures over "
        "single poses alone",
    )
    add("--noise-of", type=str, metavar="PRIOR",
        help="keep the mixtures and windows of this prior, a name or a file, which was fitted to the same "
        "recordings, and learn its process noise and its calibration over single poses")  # fmt: skip
    add("--folds", type=int, default=6, metavar="N",
        help="groups of persons that are held out in turn (default 6; 0 for none)")  # fmt: skip
    add("--drawn-pieces", type=int, default=6, metavar="N",
        help="pieces of recordings, of 60 frames, of each of these groups on which the covariances of "
        "the methods that draw are calibrated (default 6; 0 for none)")  # fmt: skip
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
    """Read, curate, fit, write and report; every check of an option comes before any work."""
    from torchpose.io._recordings import find_recordings, read_recordings
    from torchpose.learning._fit_files import check_fit_file, fit_results, write_prior_files

    _check_options(args)
    out = check_fit_file(args.out)
    recordings = read_recordings(find_recordings(args.recordings), args.axes)
    pictures = pictures_possible(args.pictures)
    recordings, curation = _curated(_without(recordings, args.without or []), args)
    with fit_results(out, input_files(args), pictures) as results:
        print(curation["said"], flush=True)
        prior = _fit(recordings, args, args.name or out.stem)
        prior.info = replace(prior.info, extra=prior.info.extra | curation["facts"])
        done = write_prior_files(prior, results, out.name, pictures)
    print(done)
    return 0


def _fit(recordings: list["Recording"], args: Namespace, name: str) -> "UpperBodyPrior":
    facts = {"name": name, "licence": args.licence, "command": recorded_command(args)}
    own = {"neck": args.neck} | ({"n_samples": args.samples} if args.samples else {})
    if args.noise == "none":
        from torchpose.learning._upper_body import fit_upper_body_prior

        settings: dict[str, Any] = facts | own | {"progress": show_progress()}
        return fit_upper_body_prior(recordings, args.components, args.seed, **settings)
    from torchpose.learning._recipes.upper_body import UpperBodyRecipe

    if args.noise_of is not None:
        from torchpose.learning._recipes.renewal import renew_noise
        from torchpose.priors._upper_body import load_prior

        before = load_prior(args.noise_of)
        return renew_noise(
            before, recordings, calibration_folds=args.folds, drawn_pieces=args.drawn_pieces,
            command=facts["command"], progress=show_progress(),
        )  # fmt: skip
    recipe = UpperBodyRecipe(
        n_components=args.components,
        window_components=args.window_components,
        calibration_folds=args.folds,
        drawn_pieces=args.drawn_pieces,
        seed=args.seed,
        **own,
    )
    return recipe.fit(recordings, progress=show_progress(), **facts)


def _curated(
    recordings: list["Recording"], args: Namespace
) -> tuple[list["Recording"], dict[str, Any]]:
    """Recordings without what is no body, what was dropped in words, and as facts for the card."""
    if not args.curate:
        return recordings, {"said": f"read     {_count(recordings)}", "facts": {}}
    from torchpose.learning._curation import curate
    from torchpose.learning._curation.curate import CurationSettings

    curated = curate(recordings, CurationSettings(harmonise=args.harmonise))
    report = curated.report
    return curated.recordings, {"said": report.text(_SHOWN_DROPS), "facts": report.for_prior()}


def _without(recordings: list["Recording"], persons: list[str]) -> list["Recording"]:
    """Recordings of everybody else."""
    from torchpose.learning._curation.splits import pick_persons

    out = pick_persons(persons, sorted({r.person_id for r in recordings}))
    return [r for r in recordings if r.person_id not in out]


def _check_options(args: Namespace) -> None:
    from torchpose.io._formats.axes import AXES
    from torchpose.skeleton._upper_body import NECK_KINDS

    for option, value, known in (
        ("--axes", args.axes, AXES),
        ("--neck", args.neck, NECK_KINDS),
        ("--noise", args.noise, _NOISE),
    ):
        if value is not None and value not in known:
            raise InputError(f"{option} must be one of {', '.join(known)}, got {value!r}")
    for option, count, least in (
        ("--components", args.components, 1),
        ("--samples", args.samples, 1),
        ("--window-components", args.window_components, 0),
        ("--folds", args.folds, 0),
        ("--drawn-pieces", args.drawn_pieces, 0),
    ):
        if count is not None and count < least:
            raise InputError(f"{option} must be at least {least}, got {count}")
    if args.noise == "none" and args.noise_of:
        raise InputError("--noise-of learns noise; leave --noise out")
    if args.noise == "none" and args.window_components:
        raise InputError("--window-components applies only with --noise learnt")


def recorded_command(args: Namespace) -> str:
    """Return the command as the prior's file says it."""
    return command_line(("fit",), args, build().get_defaults(), args.out)


def _count(recordings: list["Recording"]) -> str:
    persons = len({r.person_id for r in recordings})
    frames = sum(len(r) for r in recordings)
    return f"{len(recordings)} recordings of {persons} persons, {frames} frames"
