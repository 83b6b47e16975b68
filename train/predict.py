"""Track many recordings with `python -m train predict`, in one process or several, resumable.

Every process takes the recordings rank, rank + world, ... of one list, the longest first. Then it takes
what is left, so that no recording is lost when a process dies. A recording is claimed before work
begins (`train.predict_claims`). It is done when a result from the same input, prior and settings exists,
so nothing is computed twice and the next run resumes.
"""

import contextlib
import os
import re
import sys
import time
from argparse import ArgumentError
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jsonargparse import ActionConfigFile, ArgumentParser
from tqdm.auto import tqdm

from torchpose._core.files import check_output_folder, clear_leftovers
from torchpose._core.terminal import one_line, show_progress
from torchpose._core.wording import counted
from torchpose.errors import InputError, OutputError, TorchposeError
from torchpose.upper_body._keypoint_files import TrackSettings
from train.argument_errors import configuration_files, describe_argument_error
from train.predict_claims import Claim, Claims, Run
from train.predict_recordings import KeypointRecording, find_keypoints, share
from train.predict_summary import (
    OTHER,
    Outcome,
    check_summary,
    count_outcomes,
    name_notes,
    name_others,
    write_summary,
)
from train.predict_tracking import (
    BatchTracker,
    facts_of,
    read_origin,
    save_result,
)

__all__ = ["Batch", "main", "predict"]

SUMMARY = "summary.csv"
CLAIMS = ".claims"
_MOST_DEATHS = 3  # of processes, at one recording
_RANKS = (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command: 0 done; 1 done, but some recordings are not; 2 refused, with one line why.

    Ctrl-C is left to `train.cli.main`.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in arguments
    try:
        options = build().parse_args([a for a in arguments if a != "--debug"])
        rank, world = process_rank(options.rank, options.world)
        settings = TrackSettings(**vars(options.track))
        outcomes = predict(
            options.recordings, options.out, settings, rank, world,
            device=options.device, retry_failed=options.retry_failed, progress=show_progress(),
        )  # fmt: skip
    except SystemExit as stop:  # --help and --print_config
        return stop.code if isinstance(stop.code, int) else 0
    except (ArgumentError, TorchposeError) as error:
        if debug:
            raise
        print(f"train: error: {_reason(error, arguments)}", file=sys.stderr)
        return 2
    print(f"process {rank} of {world}: {count_outcomes(outcomes)}")
    if rank == 0:
        for line in name_others(outcomes):
            print(f"train: warning: {line}", file=sys.stderr)
        for note in name_notes(outcomes):
            print(f"note     {_as_typed(note)}")
        print(f"summary  {Path(options.out) / SUMMARY}")
    return 0 if all(outcome.good for outcome in outcomes.values()) else 1


def _reason(error: BaseException, arguments: Sequence[str]) -> str:
    """Return what was wrong, in one sentence."""
    text = one_line(error)
    if not isinstance(error, ArgumentError) or text.startswith("missing: "):
        return _as_typed(text)
    if "does not support item assignment" in text:
        files = ", ".join(map(str, configuration_files(arguments)))
        return f"{files}: recordings: expected a list, such as [keypoints/]"
    return describe_argument_error(str(error), arguments, "predict")


def _as_typed(text: str) -> str:
    """Return a message with the options of `torchpose track` as they are typed here.

    >>> _as_typed("expected --camera FILE or --camera-name NAME")
    'expected --track.camera FILE or --track.camera_name NAME'
    """

    def typed(option: re.Match[str]) -> str:
        name = option[1].replace("-", "_")
        return f"--track.{name}" if name in TrackSettings.__dataclass_fields__ else option[0]

    return re.sub(r"--([a-z][a-z-]*)", typed, text)


def build() -> ArgumentParser:
    """Return the parser of the command."""
    parser = ArgumentParser(
        prog="python -m train predict",
        description="Track many recordings of 2D keypoints; processes of torchrun or srun share them.",
        exit_on_error=False,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("--config", action=ActionConfigFile, metavar="FILE", help="these options as YAML")
    add("recordings", nargs="+", type=str, metavar="DIR",
        help="folders (with their subfolders) or files: .npz, .csv, JSON of OpenPose")  # fmt: skip
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add("--device", type=str, default="cpu",
        help="cpu, or cuda, of which each process of a machine takes one (default cpu)")  # fmt: skip
    add("--retry_failed", type=bool, default=False, metavar="true|false",
        help="try recordings again that could not be tracked (default false)")  # fmt: skip
    add("--rank", type=int | None, default=None, metavar="N",
        help="number of this process; by default what torchrun or srun says, else 0")  # fmt: skip
    add("--world", type=int | None, default=None, metavar="N", help="number of processes")
    parser.add_class_arguments(TrackSettings, "track")
    return parser


def process_rank(rank: int | None = None, world: int | None = None) -> tuple[int, int]:
    """Return the number of this process and of all of them: as given, else as torchrun or srun says.

    Raises:
        InputError: one without the other, or a number outside of 0 .. world - 1.
    """
    if (rank is None) != (world is None):
        raise InputError(f"--rank and --world go together, got {rank} and {world}")
    if rank is None or world is None:
        known = [pair for pair in _RANKS if all(name in os.environ for name in pair)]
        rank, world = (int(os.environ[name]) for name in known[0]) if known else (0, 1)
    if not 0 <= rank < world:
        raise InputError(
            f"--rank must lie in 0..{world - 1} for {counted(world, 'process', 'processes')}, got {rank}"
        )
    return rank, world


def predict(
    recordings: Sequence[str | Path],
    out: str | Path,
    settings: TrackSettings | None = None,
    rank: int = 0,
    world: int = 1,
    *,
    device: str = "cpu",
    retry_failed: bool = False,
    progress: bool = False,
) -> dict[str, Outcome]:
    """Track recordings together with other processes; return when all are done.

    Args:
        recordings: files and folders of keypoints (`find_keypoints`).
        out: folder of the results: NAME.npz for each recording and a summary.
        settings: how to track. rank, world: which process of how many.
        device: "cpu", "cuda" (the one of this process's place on its machine), or "cuda:1".
        retry_failed: try again what could not be tracked in an earlier run.
        progress: whether to show a bar.

    Returns:
        What became of every recording, by name, and of other files in the folders, by path.

    Raises:
        InputError, PriorError, CameraError: settings that suit no recording, no recordings.
        OutputError: results cannot be written. A recording that is bad raises nothing.
    """
    out = check_output_folder(out)
    check_summary(out / SUMMARY)
    found, others = find_keypoints(recordings, out)
    tracker = BatchTracker(settings or TrackSettings(), _own_device(device))
    claims = Claims(out / CLAIMS, alone=world == 1)
    task = ",".join([*tracker.task.values(), *sorted(recording.name for recording in found)])
    bar = tqdm(total=len(found), disable=not progress or rank > 0, unit="recording", desc="predict")
    with claims.run(task) as run, bar:
        batch = Batch(tracker, out, run, rank, retry_failed)
        outcomes: dict[str, Outcome] = {}

        def settle(recording: KeypointRecording, claim: Claim) -> None:
            outcomes[recording.name] = batch.settle(recording, claim)
            bar.update(1)

        _visit(claims, share(found, rank, world), settle)
    outcomes |= {path: Outcome(path, OTHER, error=fault) for path, fault in others.items()}
    write_summary(out / SUMMARY, outcomes)
    return outcomes


def _visit(
    claims: Claims,
    recordings: Sequence[KeypointRecording],
    settle: Callable[[KeypointRecording, Claim], None],
) -> None:
    """Settle every recording; wait at the end for those that other processes work on."""
    others = []
    for recording in recordings:
        with claims.claim(recording.name) as claim:
            if claim is None:
                others.append(recording)
            else:
                settle(recording, claim)
    for recording in others:
        with claims.claim(recording.name, wait=True) as claim:
            if claim is not None:
                settle(recording, claim)


class Batch(NamedTuple):
    """The work of a process on the recordings that it has claimed."""

    tracker: BatchTracker
    out: Path
    run: Run
    rank: int = 0
    retry_failed: bool = False

    def settle(self, recording: KeypointRecording, claim: Claim) -> Outcome:
        """Track a recording, unless it is done already or has failed before.

        Raises:
            OutputError: the result cannot be written.
        """
        result = self.out / f"{recording.name}.npz"
        try:
            origin = self.tracker.origin(recording)
            there = read_origin(result, known=bool(claim.history)) if result.is_file() else None
        except (OSError, InputError) as error:
            return Outcome(recording.name, "failed", error=one_line(error))
        if there is not None and there["origin"] == origin:
            return Outcome(recording.name, "found", there["facts"])
        last: dict[str, Any] = claim.history[-1] if claim.history else {}
        if last.get("event") == "failed" and last["origin"] == origin and self._final(last):
            return Outcome(recording.name, "failed", error=last["error"])
        if claim.deaths:
            clear_leftovers(result.parent)
        if claim.deaths >= _MOST_DEATHS and not self.retry_failed:
            text = f"{counted(claim.deaths, 'process', 'processes')} died at it, of memory perhaps"
            claim.record("failed", origin=origin, error=text, final=True, run=self.run.id)
            return Outcome(recording.name, "failed", error=text)
        claim.record("started", rank=self.rank, recording=recording.name)
        started = time.monotonic()
        try:
            track = self.tracker(recording)
            facts = facts_of(track, started)
            save_result(result, track, origin, facts)
        except (OutputError, KeyboardInterrupt, SystemExit):
            with contextlib.suppress(OSError):
                claim.record("stopped")  # so that it counts as no death at this recording
            raise
        except Exception as error:  # one bad recording does not stop the others
            typed = isinstance(error, TorchposeError)
            text = _as_typed(one_line(error))
            text = text if typed else f"{type(error).__name__}: {text}"
            claim.record("failed", origin=origin, error=text, final=typed, run=self.run.id)
            return Outcome(recording.name, "failed", error=text)
        claim.record("finished")
        return Outcome(recording.name, "made", facts)

    def _final(self, failure: dict[str, Any]) -> bool:
        """Return whether a failure is final; one that the input did not cause may not recur."""
        return failure["run"] == self.run.id or (failure["final"] and not self.retry_failed)


def _own_device(device: str) -> str:
    """Return one of several devices for each process of a machine."""
    if device != "cuda":
        return device
    import torch

    place = int(os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0)))
    return f"cuda:{place % max(1, torch.cuda.device_count())}"
