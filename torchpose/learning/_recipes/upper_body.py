"""Fit upper-body priors: mixtures over poses and windows, their noise, and calibration.

`torchpose fit`, the training loop and the evaluation protocols run the recipe as a whole or by steps.
`tasks` lists the mixtures and the states to fit them to. Any implementation of EM can fit them.
`assemble` builds a prior of them, and `calibrate` measures it on held-out persons.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Unpack

import torch
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_count
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._viewpoints import ViewRange
from torchpose.errors import InputError, PriorError
from torchpose.learning._recipes.calibration import (
    DRAWN,
    MODES,
    STILL,
    HeldOut,
    calibration_noise,
    folds,
    still_poses,
    track_held_out,
)
from torchpose.learning._recipes.settings import RecipeSettings
from torchpose.learning._samplers import SampleSource, WindowSource, derived_seed
from torchpose.learning._streamed_em import ColumnsSource, MixtureTask
from torchpose.learning._training import (
    TRAINING_VIEWS,
    ArmSources,
    PoseSet,
    RecordingLike,
    arm_sources,
    collect_poses,
    short_paths,
)
from torchpose.learning._upper_body_prior_fit import KINECT_CAMERA, increment_covs, prior_of_arms
from torchpose.priors._arm_state import check_rotation_order
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._prior_file import PriorInfo
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowLayout, WindowPrior

VERSION = "5"
"""Version of the recipe; cached priors of another version are not used."""

_SIDES = ("left", "right")
# Chosen on held-out training persons; see the benchmarks page for what each was worth.
_POWER = {"causal": 0.3, "full": 0.25}
# q/r of the motion stage, 1/s^3: where errors of held-out training persons were least, and a body
# stays as smooth as the Kinect sees it.
_JOINT_RATIO = {"causal": 1e4, "full": 3e4}
_PIXEL_RATIO, _PLACEMENT_RATIO = 1e5, 1e2
_MEASUREMENT_STD = 3.0
_WINDOW_COMPONENTS = 8  # times those over poses
_WINDOW_SAMPLES, _WINDOWS_PER_FRAME = 120_000, 60
_REACH = 1.1  # metres from the neck to the farthest joint, at most
_FRAMES_PER_COMPONENT = 180  # of a mixture over windows; fewer explain the person, not the motion


@dataclass(frozen=True)
class UpperBodyRecipe:
    """Holds the settings of the fit of an upper-body prior, and runs its steps.

    1. One mixture per arm over single poses (BL section 3.1), and process noise for the filters, from
       how far a frame moves the recorded bodies (`increment_covs`).
    2. Mixtures per arm over windows: poses with the hands' pixels around them (`WindowPrior`), from
       bodies of varied size, once with the past alone ("causal") and once with both sides ("full").
    3. For each of the three, and each of the filters that draw, a scale and a floor per joint that
       bring the covariances of the 3D joints of held-out training persons to their nominal coverage
       (`fit_calibration`).

    Args:
        n_components: Gaussians per arm over single poses. n_samples: states each arm is fitted to.
        pose_steps, pose_tol: most steps of EM, and the change of the mean log-likelihood to stop at.
        window_components: Gaussians per arm over windows; by default eight times as many as over
            poses, but one for 180 recorded frames at most. 0 leaves windows out.
        window_samples: training windows; by default 60 for each frame and 120,000 at most.
        window_steps: steps of EM over windows.
        causal, full: the hands of a window.
        body_size, bone_lengths: largest relative change of a training body and of each bone.
        mirror_share: share of windows that are mirrored.
        views: limits of the random viewpoints.
        calibration_folds: groups of persons that are held out in turn; below 2, or with a single
            person, nothing is calibrated.
        drawn_pieces: pieces of recordings, of 60 frames at most, of each of these groups for the
            calibration of the filters that draw; 0 leaves them with that of the fixed tracks.
        seed: seed of viewpoints, start and everything else that is random.
        camera_matrix: fx, fy, cx, cy of the camera whose pixels the states are in.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
        neck: kind of neck to convert to: neck, low-neck, mid-shoulder; by default the highest among the
            recordings.
        mirror: fit one mixture over poses to left and mirrored right arms.
        nose_as_head: take the nose where a joint set has no head.
    """

    n_components: int = 30
    n_samples: int = 100_000
    pose_steps: int = 200
    pose_tol: float = 1e-4
    window_components: int | None = None
    window_samples: int | None = None
    window_steps: int = 20
    causal: WindowLayout = field(default=WindowLayout((4, 10, 20), (0, 10), torso=True))
    full: WindowLayout = field(
        default=WindowLayout((4, 8, 16, -4, -8, -16), (0, 8, -8), torso=True)
    )
    body_size: float = 0.30
    bone_lengths: float = 0.05
    mirror_share: float = 0.25
    views: ViewRange = TRAINING_VIEWS
    calibration_folds: int = 6
    drawn_pieces: int = 6
    seed: int = 0
    camera_matrix: tuple[float, float, float, float] = KINECT_CAMERA
    rotation_order: str = "zxy"
    neck: str | None = None
    mirror: bool = True
    nose_as_head: bool = False

    def __post_init__(self) -> None:
        check_rotation_order(self.rotation_order)
        PinholeCamera(*self.camera_matrix)  # refuses what is no camera
        for name in ("n_components", "n_samples", "pose_steps", "window_steps"):
            check_count(name, getattr(self, name))
        for name in ("window_components", "window_samples", "calibration_folds", "drawn_pieces"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise InputError(f"{name} must not be negative, got {value}")
        for name, most in (("body_size", 0.9), ("bone_lengths", 0.9), ("mirror_share", 1.0)):
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"{name} must lie in 0..{most:g}, got {getattr(self, name):g}")
        if not 0 <= self.pose_tol < math.inf:
            raise InputError(f"pose_tol must be finite and not negative, got {self.pose_tol:g}")

    @property
    def layouts(self) -> dict[str, WindowLayout]:
        """Return the hands of a window, by the window's name."""
        return {"causal": self.causal, "full": self.full}

    @property
    def matrix(self) -> Tensor:
        """Return the camera matrix K [3, 3] of the states, pixels."""
        return PinholeCamera(*self.camera_matrix).matrix

    def smaller(self) -> "UpperBodyRecipe":
        """Return a recipe of half the size without calibration, for the fits to all but some persons."""

        def half(value: int | None) -> int | None:
            return None if value is None else -(-value // 2)

        return replace(
            self,
            n_components=-(-self.n_components // 2),
            n_samples=-(-self.n_samples // 2),
            window_components=half(self.window_components),
            window_samples=half(self.window_samples),
            window_steps=-(-self.window_steps // 2),
            calibration_folds=0,
        )

    def poses(
        self, recordings: Sequence[RecordingLike], others: Sequence[RecordingLike] = ()
    ) -> PoseSet:
        """Collect the poses that are fitted, centred on the neck.

        Args:
            recordings: the recordings, in camera axes, metres.
            others: recordings that tell where the neck is, if none of these does (`collect_poses`).

        Returns:
            `PoseSet` of all recordings, with one kind of neck.

        Raises:
            InputError, PriorError: as `collect_poses`.
        """
        return collect_poses(recordings, self.neck, "neck", self.nose_as_head, others)

    def tasks(
        self, recordings: Sequence[RecordingLike], others: Sequence[RecordingLike] = ()
    ) -> dict[str, MixtureTask]:
        """Return the mixtures to fit, by name.

        Names are "pose" (and "pose.right" where arms are not mirrored), "causal.left", "causal.right",
        "full.left" and "full.right".

        Args:
            recordings: the recordings, in camera axes, metres. others: see `poses`.

        Returns:
            `MixtureTask` by name; each can be fitted in a process of its own.

        Raises:
            InputError: no usable frames. PriorError: kinds of joints that cannot be mixed.
        """
        poses = self.poses(recordings, others)
        arms = self._arms(poses)
        tasks = {}
        for name, source in (("pose", arms.left), ("pose.right", arms.right)):
            if source is not None:
                seed = derived_seed(self.seed, f"start {name}")
                tasks[name] = MixtureTask(
                    source, self.n_components, self.pose_steps, self.pose_tol, seed
                )
        return tasks | self._window_tasks(poses)

    def _arms(self, poses: PoseSet) -> ArmSources:
        return arm_sources(
            poses, self.matrix, self.seed, self.views, self.rotation_order, self.mirror,
            self.n_samples,
        )  # fmt: skip

    def _window_tasks(self, poses: PoseSet) -> dict[str, MixtureTask]:
        frames = poses.frames()
        tasks = {}
        for mode, layout in self.layouts.items():
            centres = frames.complete(layout)
            components, samples = self._window_size(len(centres))
            if not components or not samples:
                continue
            for side in _SIDES:
                name = f"{mode}.{side}"
                source: SampleSource = WindowSource(
                    self.matrix, self.views, self.rotation_order, samples,
                    derived_seed(self.seed, f"windows {mode}"), False, frames, centres, layout, side,
                    self.body_size, self.bone_lengths, self.mirror_share,
                )  # fmt: skip
                if layout.torso:
                    source = ColumnsSource(source, layout.deciding)
                seed = derived_seed(self.seed, f"start {name}")
                tasks[name] = MixtureTask(source, components, self.window_steps, 0.0, seed)
        return tasks

    def _window_size(self, n_frames: int) -> tuple[int, int]:
        """Return components and samples of a mixture over windows, for this number of complete frames."""
        components, samples = self.window_components, self.window_samples
        if components is None:
            most = max(1, n_frames // _FRAMES_PER_COMPONENT)
            components = min(_WINDOW_COMPONENTS * self.n_components, most)
        if samples is None:
            samples = min(_WINDOW_SAMPLES, _WINDOWS_PER_FRAME * n_frames)
        return components, samples if n_frames else 0

    def assemble(
        self,
        recordings: Sequence[RecordingLike],
        mixtures: Mapping[str, GaussianMixture],
        *,
        name: str = "",
        licence: str = "",
        command: str = "",
    ) -> UpperBodyPrior:
        """Build a prior of fitted mixtures, with noise and windows; it is not calibrated.

        Args:
            recordings: the same that `tasks` was given. mixtures: whole ones (`MixtureTask.whole`), by the
                names of the tasks.
            name, licence, command: for `PriorInfo`.

        Returns:
            `UpperBodyPrior`, not calibrated.

        Raises:
            PriorError: the mixture over poses is missing.
        """
        if "pose" not in mixtures:
            raise PriorError(f"expected the mixture 'pose', got {', '.join(mixtures) or 'none'}")
        facts = self._arms(self.poses(recordings)).facts
        facts = facts | {"extra": facts["extra"] | {"recipe": VERSION}}
        fx, fy, cx, cy = self.camera_matrix
        info = PriorInfo(
            name=name, rotation_order=check_rotation_order(self.rotation_order), fx=fx, fy=fy, cx=cx, cy=cy,
            licence=licence, command=command, views=asdict(self.views), **facts,
        )  # fmt: skip
        base = prior_of_arms(mixtures["pose"], mixtures.get("pose.right"), info, self.seed)
        noise = {"measurement_std": torch.full((5,), _MEASUREMENT_STD, dtype=torch.float64)}
        noise |= self.process_noise(base, recordings)
        windows = {
            mode: self.window(mode, mixtures) for mode in self.layouts if f"{mode}.left" in mixtures
        }
        return UpperBodyPrior(base.left, base.right, base.info, noise, windows)

    def process_noise(
        self, prior: UpperBodyPrior, recordings: Sequence[RecordingLike]
    ) -> dict[str, Tensor]:
        """Return the second moments of recorded steps, by the names that the filters look for.

        Recordings of people who walk past the camera are cut into parts near its usual place.

        Args:
            prior: mixtures over poses; a millionth of their variance keeps Q regular. recordings: those
                that they were fitted on.

        Returns:
            Covariances per frame by name, in the units of the state.
        """
        poses = collect_poses(recordings, self.neck, "sequence", self.nose_as_head)
        seen = self.matrix, self.views, self.rotation_order, self.mirror, self.seed
        try:
            covs = increment_covs(poses, *seen)
        except InputError:  # joints behind the camera
            near = short_paths(poses, max(self.views.tz[0] - _REACH, 0.0))
            covs = increment_covs(near, *seen)
        noise = {}
        for side, cov in covs.items():
            mixture = getattr(prior, side)
            within = torch.einsum("k,kii->i", mixture.weights, mixture.covariances)
            noise[f"increment_cov_{side}"] = cov + 1e-6 * torch.diag(within)
        return noise

    def window(self, mode: str, mixtures: Mapping[str, GaussianMixture]) -> WindowPrior:
        """Build the window prior of one mode from the mixtures that were fitted to it.

        Args:
            mode: "causal" or "full".
            mixtures: whole ones, by the names of `tasks`.

        Returns:
            `WindowPrior` of both arms, its numbers rounded to single precision.
        """
        # Single precision moves estimates by a thousandth of a millimetre, and files are half as large.
        left, right = (mixtures[f"{mode}.{side}"].rounded() for side in _SIDES)
        return WindowPrior(left, right, self.layouts[mode], _window_settings(mode))

    def calibrate(
        self, prior: UpperBodyPrior, recordings: Sequence[RecordingLike], progress: bool
    ) -> UpperBodyPrior:
        """Hold groups of persons out in turn, and calibrate the prior by the errors on them.

        Sets the calibration of the covariances, and notes the error of each person, tracked by a fit
        of half the size to the others, in `info.extra["held_out"]`.

        Args:
            prior: the prior from `assemble`; it is changed. recordings: those that it was fitted on.
            progress: whether to show a bar.

        Returns:
            The prior.
        """
        groups = folds([r.person_id for r in recordings], self.calibration_folds)
        parts = [
            self.hold_out(recordings, group)
            for group in tqdm(groups, disable=not progress, unit="fold", desc="calibration")
        ]
        return self.finish(prior, parts)

    def hold_out(
        self, recordings: Sequence[RecordingLike], persons: set[str]
    ) -> dict[str, HeldOut]:
        """Return the errors on some persons, tracked with a fit of half the size to all others.

        The neck is that of the others, where they lack the recipe's kind; so held-out persons have
        it too.

        Args:
            recordings: the recordings of all persons.
            persons: ids (`Recording.person_id`) of those held out.

        Returns:
            `HeldOut` by mode of tracking, and of the mean pose: errors and covariances of 3D joints, metres.
            None if the others have no neck, since nothing can be fitted to them.

        Raises:
            InputError, PriorError: as `tasks`, of the recordings that are left.
        """
        seen = [r for r in recordings if r.person_id not in persons]
        kinds = {r.upper_body(self.nose_as_head).neck for r in seen}
        if kinds == {None}:
            return {}
        neck = self.neck if self.neck in kinds else None
        partial = replace(self.smaller(), neck=neck).fit(seen)
        poses = replace(self, neck=partial.info.neck).poses(recordings)
        found = track_held_out(partial, poses, persons, self.seed, self.drawn_pieces)
        still = still_poses(partial, poses, persons)
        return found if still is None else found | {STILL: still}

    def finish(self, prior: UpperBodyPrior, parts: Sequence[dict[str, HeldOut]]) -> UpperBodyPrior:
        """Calibrate a prior by the errors on held-out persons.

        Args:
            prior: the prior from `assemble`; it is changed.
            parts: what `hold_out` returned for each group of persons.

        Returns:
            The prior.
        """
        found = HeldOut.join_modes(parts)
        tracked = {mode: part for mode, part in found.items() if mode != STILL}
        for key, value in calibration_noise(tracked).items():
            prior.set_noise(key, value)
        errors = {
            mode: {person: round(error, 5) for person, error in part.error_by_person().items()}
            for mode, part in found.items()
        }
        before = prior.info.extra
        extra: dict[str, Any] = {
            "calibrated": sorted(name for name in prior.noise if name.startswith("calibration"))
        }
        for name, among in (("held_out", set(MODES)), ("held_out_drawn", set(DRAWN))):
            own = {mode: value for mode, value in errors.items() if mode in among}
            if own:
                extra[name] = before.get(name, {}) | own
        if STILL in errors:
            extra["held_out_still"] = errors[STILL]
        prior.info = replace(prior.info, extra=before | extra)
        return prior

    def fit(
        self,
        recordings: Sequence[RecordingLike],
        *,
        name: str = "",
        licence: str = "",
        command: str = "",
        progress: bool = False,
    ) -> UpperBodyPrior:
        """Fit, assemble and calibrate a prior in this process.

        Args:
            recordings: the recordings, in camera axes (`torchpose.io.read_recordings`), metres.
            name, licence, command: for `PriorInfo`.
            progress: whether to show bars.

        Returns:
            `UpperBodyPrior` in float64.

        Raises:
            InputError, PriorError: as `tasks`.
        """
        tasks = self.tasks(recordings).items()
        bar = tqdm(tasks, disable=not progress, unit="mixture", desc="fit")
        mixtures = {key: task.fit() for key, task in bar}
        prior = self.assemble(recordings, mixtures, name=name, licence=licence, command=command)
        return self.calibrate(prior, recordings, progress)


def fit_kinect_prior(
    recordings: Sequence[RecordingLike],
    n_components: int = 30,
    seed: int = 0,
    views: ViewRange = TRAINING_VIEWS,
    *,
    name: str = "",
    licence: str = "",
    command: str = "",
    progress: bool = False,
    **settings: Unpack[RecipeSettings],
) -> UpperBodyPrior:
    """Fit the recipe of the shipped prior to recorded 3D poses: `UpperBodyRecipe.fit`.

    Args:
        recordings: the recordings, in camera axes (`torchpose.io.read_recordings`).
        n_components, seed, views, **settings: of `UpperBodyRecipe`.
        name, licence, command: for `PriorInfo`. progress: whether to show bars.

    Returns:
        `UpperBodyPrior` in float64.

    Raises:
        InputError, PriorError: as `UpperBodyRecipe.tasks`.
    """
    recipe = UpperBodyRecipe(n_components=n_components, seed=seed, views=views, **settings)
    return recipe.fit(recordings, name=name, licence=licence, command=command, progress=progress)


def _window_settings(mode: str) -> dict[str, float]:
    """Return settings of the filter over windows, and of the motion stage behind it."""
    return {
        "hand_std": _MEASUREMENT_STD,
        "likelihood_power": _POWER[mode],
        "joint_ratio": _JOINT_RATIO[mode],
        "pixel_ratio": _PIXEL_RATIO,
        "placement_ratio": _PLACEMENT_RATIO,
    }
