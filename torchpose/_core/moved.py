"""Keep old names working for one release, with a `DeprecationWarning`: modules, names, arguments.

`MODULES`, `NAMES` and `ARGUMENTS` are the whole table. All are to go in version 0.3.0.
"""

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

__all__ = [
    "ARGUMENTS",
    "MODULES",
    "NAMES",
    "install",
    "moved_from",
    "moved_function",
    "moved_names",
    "present_module",
    "warn_of_former",
]

_PACKAGE = Path(__file__).parents[1]
_BETWEEN = {"torchpose", "torch", "importlib"}  # packages between a program and a warning

MODULES = {
    "arm_filters": "upper_body._single_poses",
    "arm_windows": "upper_body._windows",
    "arms": "upper_body._estimator",
    "body.body_parameters": "body._limbs",
    "body.limb_batches": "whole_body._silhouettes.limb_batches",
    "body.limb_counts": "whole_body._silhouettes.limb_counts",
    "body.limb_outlines": "whole_body._silhouettes.outlines",
    "body.quaternion_vectors": "math._rotations",
    "body.rectangles": "whole_body._silhouettes.outlines",
    "body.row_intervals": "whole_body._silhouettes.outlines",
    "body.shape": "whole_body._silhouettes.shape",
    "body.silhouette": "whole_body._silhouettes.rendering",
    "body.silhouette_likelihood": "whole_body._silhouettes.likelihood",
    "body_poses": "whole_body._body_track",
    "body_tracking": "whole_body._body_tracker",
    "body_view": "camera._virtual_camera",
    "calibration": "metrics._calibration",
    "camera_rig": "camera._rig",
    "cli.camera_option": "camera._choice",
    "cli.pose_csv": "upper_body._pose_files",
    "cli.prior_files": "learning._fit_files",
    "collapse": "upper_body._reading",
    "curation": "learning._curation",
    "filters.annealed": "whole_body._filters.annealed",
    "filters.base": "filters._recursive_filter",
    "filters.body_frames": "whole_body._filters.body_frames",
    "filters.body_particles": "whole_body._filters.body_particles",
    "filters.constrained": "whole_body._filters.constrained",
    "filters.first_order": "whole_body._filters.motion",
    "filters.first_pose": "whole_body._first_pose",
    "filters.frame_weights": "filters._memoryless",
    "filters.gains": "filters._gain_graph",
    "filters.gamma": "filters._transition",
    "filters.geometric_median": "math._geometric_median",
    "filters.joint_spread": "whole_body._filters.body_particles",
    "filters.leg_swap": "whole_body._filters.legs",
    "filters.limb_observations": "whole_body._filters.limb_observations",
    "filters.manifold": "whole_body._filters.manifold_regularised",
    "filters.mending": "filters._outputs",
    "filters.particle_options": "filters._particle",
    "filters.pose_search": "whole_body._pose_search",
    "filters.posture_gate": "whole_body._filters.posture_gate",
    "filters.redraw": "whole_body._filters.posture_gate",
    "filters.root_uncertainty": "whole_body._filters.root_uncertainty",
    "filters.scan": "filters._shared_gains",
    "filters.sharpness": "whole_body._sharpness",
    "filters.silhouette_filter": "whole_body._filters.silhouette_filter",
    "filters.sir": "whole_body._filters.sir",
    "filters.survival": "filters._resampling",
    "filters.tracks": "filters._mkf",
    "filters.tree_messages": "math._tree_messages",
    "gaussian": "math._gaussian",
    "io.axes": "io._formats.axes",
    "io.azure_json": "io._formats.skeleton_files",
    "io.bvh": "upper_body._pose_files",
    "io.bvh_recordings": "io._formats.mocap_files",
    "io.c3d_recordings": "io._formats.mocap_files",
    "io.estimates": "_core.estimates",
    "io.fields": "_core.reading",
    "io.files": "_core.files",
    "io.kinect_csv": "io._formats.kinect_csv",
    "io.kinect_v1": "io._formats.skeleton_files",
    "io.landmarks": "skeleton._mediapipe_landmarks",
    "io.leftovers": "_core.files",
    "io.npz": "_core.reading",
    "io.npz_recordings": "io._formats.raw_recording",
    "io.ntu_skeleton": "io._formats.skeleton_files",
    "io.openpose": "io._formats.openpose",
    "io.raw_recording": "io._formats.raw_recording",
    "io.reading": "_core.reading",
    "io.units": "io._formats.axes",
    "joint_sets": "skeleton._joint_sets",
    "lifting": "camera._projection",
    "mannequin": "demo._mannequin",
    "measure.face_memory": "measure._head",
    "measure.hand_measurements": "measure._hand_likelihood",
    "measure.hand_settings": "measure._hand_likelihood",
    "measure.head_neck": "measure._head",
    "measure.motion": "measure._background",
    "measure.silhouettes": "video._silhouettes",
    "measure.torso": "measure._torso_elbows",
    "measure.upper_body": "measure._upper_body_measurer",
    "measurements": "upper_body._measured_joints",
    "methods": "upper_body._estimator_table",
    "metric_arguments": "_core.arguments",
    "module_state": "_core.module_state",
    "person_stream": "video._person_stream",
    "pose_spool": "video._recording",
    "pose_track": "upper_body._pose_track",
    "priors.action_bank": "priors._actions.bank",
    "priors.action_chain": "priors._actions.stack",
    "priors.action_file": "priors._actions.action_file",
    "priors.action_fit": "learning._action_spaces",
    "priors.action_gate": "priors._actions.gate",
    "priors.action_recognition": "learning._action_spaces",
    "priors.action_space": "priors._actions.space",
    "priors.action_stack": "priors._actions.stack",
    "priors.body_card": "learning._model_card",
    "priors.completion": "learning._streamed_em",
    "priors.em": "math._mixture_em",
    "priors.features": "math._mixture_steps",
    "priors.fine_tuning": "learning._fine_tuning",
    "priors.gmm": "priors._gaussian_mixture",
    "priors.gplvm": "priors._manifold.gplvm",
    "priors.gplvm_fit": "learning._gplvm_fit",
    "priors.gplvm_kernel": "priors._manifold.prediction",
    "priors.gplvm_noise": "learning._manifolds",
    "priors.gplvm_prediction": "priors._manifold.prediction",
    "priors.increments": "learning._upper_body_prior_fit",
    "priors.manifold_file": "priors._manifold.manifold_file",
    "priors.model_card": "learning._model_card",
    "priors.neck": "skeleton._torso",
    "priors.part_postures": "priors._actions.part_postures",
    "priors.polar_limbs": "priors._actions.polar_limbs",
    "priors.pose_sequences": "learning._manifolds",
    "priors.postures": "priors._actions.postures",
    "priors.prior_noise": "priors._prior_file",
    "priors.repetitions": "learning._performances",
    "priors.samplers": "learning._samplers",
    "priors.seen_keypoints": "learning._training",
    "priors.selection": "learning._selection",
    "priors.share": "learning._blocks",
    "priors.start": "math._mixture_start",
    "priors.stepwise_em": "learning._stepwise_em",
    "priors.streamed_em": "learning._streamed_em",
    "priors.synchronisation": "learning._performances",
    "priors.tensor_file": "_core.tensor_file",
    "priors.training": "learning._training",
    "priors.upper_body": "priors._upper_body_prior",
    "priors.usable_samples": "learning._blocks",
    "process_noise": "upper_body._single_poses",
    "projection": "camera._projection",
    "protocols": "evaluation",
    "protocols.common": "evaluation._trials",
    "protocols.persons": "evaluation._person_recordings",
    "read_out": "upper_body._fusion",
    "recipes": "learning._recipes",
    "recording": "video._recording",
    "rendering": "demo._rendering",
    "rendering.portrait": "demo._rendering.look",
    "report": "viz._report",
    "rotation_gaussians": "math._rotation_gaussians",
    "rotations": "math._rotations",
    "streaming": "upper_body._live_pose",
    "torchmetrics_adapters": "metrics._torchmetrics_adapters",
    "torso": "skeleton._torso",
    "tracking": "upper_body._upper_body_tracker",
    "unscented": "math._unscented",
    "value_checks": "_core.value_checks",
    "video.base": "video._source_interface",
    "video.body_overlay": "video._overlay",
    "video.live": "video._live_view",
    "video.pen": "video._overlay",
    "video.probe": "video._timing",
    "video_tracker": "video._video_tracker",
    "viewpoints": "camera._viewpoints",
    "viz.action_picture": "viz._model_pictures",
    "viz.manifold_picture": "viz._model_pictures",
}
"""Old module to present module, both without `torchpose.`; submodules follow their package.

A module that only became private (`filters.mkf` is `filters._mkf`) does not stand here.
"""

LABORATORY = frozenset(
    [
        "body.faults",
        "io.humaneva",
        "io.humaneva_joints",
        "protocols.bend",
        "protocols.bend_actions",
        "protocols.bend_data",
        "protocols.bend_occlusion",
        "protocols.bend_pictures",
        "protocols.bend_runs",
        "protocols.bend_tables",
        "protocols.bend_trackees",
        "protocols.body_models",
        "protocols.gaps",
        "protocols.kept_runs",
        "protocols.one_tables",
        "protocols.people_tables",
        "protocols.root_uncertainty",
        "protocols.root_uncertainty_pictures",
        "protocols.root_uncertainty_runs",
        "protocols.root_uncertainty_search",
        "protocols.root_uncertainty_tables",
        "protocols.root_uncertainty_trackees",
        "protocols.signer",
        "protocols.silhouette",
        "protocols.silhouette_data",
        "protocols.silhouette_humaneva",
        "protocols.silhouette_pictures",
        "protocols.silhouette_report",
        "protocols.silhouette_runs",
        "protocols.silhouette_tables",
        "protocols.silhouette_trackees",
        "protocols.ub_one",
        "protocols.ub_people",
        "protocols.uncommon_poses",
        "rendering.performances",
    ]
)
"""Modules that belong to the benchmarks of a checkout now, and are no part of the package."""

NAMES: dict[str, dict[str, str]] = {
    "torchpose": {
        "whole_body._body_track": "BodyPoses=BodyTrack",
    },
    "torchpose.body": {
        "body._fitting": "joint_errors=fit_errors",
        "body._kinematics": "FRAMES",
        "whole_body": "bidirectional count_pixels render",
        "whole_body._silhouettes.likelihood": "intersection_over_union",
        "whole_body._silhouettes.rendering": (
            "PreparedSilhouettes SilhouetteCounts prepare_silhouettes render_limbs"
        ),
        "whole_body._silhouettes.shape": "fit_radii",
    },
    "torchpose.body._fitting": {
        "body._fitting": "joint_errors=fit_errors",
    },
    "torchpose.camera": {
        "camera._projection": (
            "arm_in_body_frame arm_in_camera_frame backproject check_intrinsics intrinsics join_arms "
            "map_pixel_covariance pixel_covariances"
        ),
        "camera._rig": "RigView as_rig undistortion_maps",
        "camera._viewpoints": "PAPER_VIEWS Viewpoints",
        "math._rotations": (
            "ROTATION_ORDERS RotationOrder euler_to_matrix matrix_to_euler rotvec_to_matrix"
        ),
    },
    "torchpose.demo": {
        "demo._mannequin": "ANGLE_LIMITS BodyAngles BodySize angles_to_joints",
        "demo._performer": "Performance hip_sway minimum_jerk performer_angles stage sway",
    },
    "torchpose.filters": {
        "filters._constant_velocity": "ConstantVelocityFilter ConstantVelocityState",
        "filters._mkf": "MKFState",
        "filters._particle": "ParticleState",
        "whole_body": (
            "AnnealedParticleFilter BodyTrack=BodyFilterOutput ConstrainedParticleFilter "
            "ManifoldParticleFilter RootUncertaintyTracker SIRParticleFilter "
            "SilhouetteParticleFilter constant_velocity_std default_step_std find_first_pose find_pose "
            "fit_sharpness motion_std"
        ),
        "whole_body._filters.body_particles": "BodyFilterState",
        "whole_body._first_pose": "FirstPose",
        "whole_body._sharpness": "ValidationSequence",
    },
    "torchpose.io": {
        "_core.files": "atomic_path check_output_folder read_npz require_file write_npz",
        "io._formats.axes": "AXES",
        "io._recordings": "find_recordings",
        "io._results": "ResultsFolder",
    },
    "torchpose.learning": {
        "learning._model_card": "model_card write_model_card",
        "learning._training": "arm_sources collect_poses",
    },
    "torchpose.math": {
        "math._gaussian": (
            "Gain condition kalman_correct kalman_gain least_exponent log_prob marginal mended_cholesky "
            "mixture_moments product safe_cholesky symmetrise"
        ),
        "math._mixture_em": "FitReport MixtureParameters SufficientStatistics e_step m_step",
        "math._rotation_gaussians": (
            "left_matrix quaternion_moments right_matrix sigma_quaternions turn_gaussian"
        ),
        "math._rotations": (
            "ROTATION_ORDERS RotationOrder cross_matrix matrix_to_euler matrix_to_quaternion_vector "
            "minimal_rotation quaternion_to_vector rotvec_to_matrix vector_to_quaternion "
            "within_unit_ball"
        ),
        "math._unscented": "DIRECTIONS Directions floor_eigenvalues moments sigma_points",
    },
    "torchpose.measure": {
        "measure._association": "AssociationState HandAssociation",
        "measure._background": "BackgroundModel",
        "measure._brightness_background": "BrightnessBackground PixelKind",
        "measure._edges": "Segments edge_map find_segments limb_votes",
        "measure._face": "FaceTracker FaceTracks Region",
        "measure._hand_likelihood": "HandMeasurements HandSettings",
        "measure._hand_prior": "HandPrior",
        "measure._hands": "HandState",
        "measure._head": "FACE_OFFSETS FaceOffsets",
        "measure._mean_shift": "MeanShift mean_shift",
        "measure._mean_shift_hands": "MeanShiftHandState",
        "measure._mediapipe": "PoseLandmarks",
        "measure._persons": "PersonRegister Persons",
        "measure._skin": "SkinModel SkinState rgb_to_lab",
        "measure._skin_mixture": "SkinMixtureState",
        "measure._torso_elbows": "Elbows clothes_likelihood elbows_from_torso",
        "measure._upper_body_measurer": "FrameMeasurements MEASURED MeasurerState",
        "video._silhouettes": "SilhouetteMeasurer fit_view read_silhouettes",
    },
    "torchpose.metrics": {
        "metrics._calibration": "Coverage chi2_cdf chi2_quantile mahalanobis_squared",
        "metrics._pose_errors": (
            "ALIGN_JOINTS ARM_LIMBS Alignment ErrorSummary PCP RigidMotion limb_hits share_below"
        ),
    },
    "torchpose.priors": {
        "learning": "TRAINING_VIEWS fit_upper_body_prior",
        "learning._model_card": "model_card write_model_card",
        "learning._training": "arm_sources collect_poses",
        "math._mixture_em": (
            "FitReport MixtureParameters SufficientStatistics e_step expectation_maximisation m_step"
        ),
        "priors._actions.action_file": "ActionInfo",
        "priors._arm_state": "arm_state arm_states mirror_arm_state mirror_mixture",
        "priors._prior_file": "PriorInfo",
        "skeleton._torso": (
            "NeckFraction NeckOffset learn_neck_fraction learn_neck_offset place_neck"
        ),
    },
    "torchpose.skeleton": {
        "skeleton._joint_sets": "canonical_names identify_skeleton",
        "skeleton._torso": (
            "NeckFraction NeckOffset learn_neck_fraction learn_neck_offset place_neck"
        ),
        "skeleton._upper_body": (
            "ARM_JOINTS BONES LIMBS NECK_KINDS OTHER_SIDE UpperBody UpperBodyMap measure_neck_kind "
            "mirror_pose scale_bones"
        ),
    },
    "torchpose.upper_body": {
        "upper_body._live_pose": "StreamState",
    },
    "torchpose.upper_body._fusion": {
        "upper_body._fusion": "MotionState=MotionStageState",
    },
    "torchpose.video": {
        "_core.images": "Image",
        "video._camera": "CameraSource",
        "video._file": "FileSource",
        "video._images": "FolderSource",
        "video._prefetch": "prefetch",
        "video._silhouettes": "fit_view",
    },
    "torchpose.video._recording": {
        "video._recording": "Recording=TrackedRecording",
    },
    "torchpose.viz": {
        "viz._prior_pictures": "plot_log_likelihood plot_prior_components plot_prior_samples",
    },
    "torchpose.whole_body": {
        "whole_body": "BodyPoses=BodyTrack",
        "whole_body._filters.body_particles": "BodyFilterState joint_covariance",
        "whole_body._first_pose": "FirstPose",
        "whole_body._sharpness": "ValidationSequence",
        "whole_body._silhouettes.likelihood": "intersection_over_union",
        "whole_body._silhouettes.rendering": (
            "PreparedSilhouettes SilhouetteCounts prepare_silhouettes render_limbs"
        ),
        "whole_body._silhouettes.shape": "fit_radii",
    },
    "torchpose.whole_body._body_track": {
        "whole_body._body_track": "BodyPoses=BodyTrack",
    },
    "torchpose.whole_body._body_tracker": {
        "whole_body._following": "track_body",
    },
    "torchpose.whole_body._filters.body_particles": {
        "whole_body._filters.body_particles": "BodyTrack=BodyFilterOutput",
    },
}
"""Names that a package or module had: present home (without `torchpose.`) to the names in it.

A name that has changed is OLD=NEW.
"""

ARGUMENTS = {
    "BodyTracker.forward": "generator progress",
    "BodyTracker.init": "generator",
    "BootstrapParticleFilter.init": "generator",
    "ConstantVelocityFilter.smooth": "lengths lag",
    "MixtureKalmanFilter.init": "generator",
    "RecursiveFilter.advance": "generator return_cov",
    "RecursiveFilter.forward": "lengths generator return_cov progress",
    "RecursiveFilter.smooth": "lengths lag return_cov",
    "RecursiveFilter.step": "generator return_cov",
    "SampledTrackFilter.init": "generator",
    "SilhouetteParticleFilter.advance": "generator",
    "SilhouetteParticleFilter.forward": "generator lengths progress initial_std=initial_cov",
    "SilhouetteParticleFilter.init": "generator initial_std=initial_cov",
    "SilhouetteParticleFilter.step": "generator",
    "track_body": "generator +initial_std=initial_cov",
}
"""Functions to the arguments that they took by position, in this order, and take by name alone now.

One whose name has changed is OLD=NEW; one behind a + was taken by name before, too.
"""


def present_module(old: str) -> str | None:
    """Return the full present name of a module by its old full name, or None if it did not move."""
    parts = old.split(".")[1:]
    for length in range(len(parts), 0, -1):
        home = MODULES.get(".".join(parts[:length]))
        if home is not None:
            present = ".".join(["torchpose", home, *parts[length:]])
            return present_module(present) or present  # which may have moved once more
    *folder, name = parts
    if (_PACKAGE.joinpath(*folder) / f"_{name}.py").is_file():
        return ".".join(["torchpose", *folder, f"_{name}"])
    return None


def moved_names(package: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that had names which have moved."""
    homes = {old: (home, new) for home, old, new in moved_from(package)}

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        home, present = homes[name]
        _warn(f"{package}.{name}", f"torchpose.{home}.{present}")
        return getattr(import_module(f"torchpose.{home}"), present)

    return attribute


def moved_from(package: str) -> list[tuple[str, str, str]]:
    """Return present home, old name and present name of each object that has left a package."""
    return [
        (home, old, new or old)
        for home, names in NAMES[package].items()
        for old, _, new in (name.partition("=") for name in names.split())
    ]


def moved_function(old: str, new: str) -> Callable[..., Any]:
    """Return a method of before, which warns its caller and calls the function that replaced it.

    That function is looked up at the call, since its room is above that of the method.
    """
    home, _, name = new.rpartition(".")

    def call(*args: Any, **options: Any) -> Any:
        _warn(old, new)
        return getattr(import_module(home), name)(*args, **options)

    return call


def install() -> None:
    """Let `import` find modules by their old names."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldNames())


def warn_of_former(said: str) -> None:
    """Warn of what goes with version 0.3.0, where the program stands that uses it.

    Frames of torchpose do not count, nor those of PyTorch, which calls `forward`, and of imports.
    """
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and _package_of(frame.f_globals) in _BETWEEN:
        level, frame = level + 1, frame.f_back
    warnings.warn(f"{said} with version 0.3.0", DeprecationWarning, stacklevel=level)


def _package_of(names: dict[str, Any]) -> str:
    return str(names.get("__name__", "")).partition(".")[0]


def _warn(old: str, new: str) -> None:
    warn_of_former(f"{old} is {new} now; the old one goes")


class _OldNames:
    """Finds modules by their old names, and loads the present ones.

    A finder as `sys.meta_path` has them. The base classes of `importlib.abc` are not needed for that, and
    take as long to import as half of torchpose.
    """

    def find_spec(
        self, fullname: str, path: object = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith("torchpose."):
            return None
        if fullname.removeprefix("torchpose.") in LABORATORY:
            raise ModuleNotFoundError(
                f"{fullname} is no part of the package any more; it belongs to the benchmarks of a "
                "checkout of torchpose, python -m benchmarks.NAME (docs/benchmarks.md)",
                name=fullname,
            )
        present = present_module(fullname)
        if present is None:
            return None
        return ModuleSpec(fullname, _Alias(present))  # type: ignore[arg-type]  # no `importlib.abc.Loader`


class _Alias:
    """Returns the present module unchanged."""

    def __init__(self, present: str) -> None:
        self.present = present

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        _warn(spec.name, self.present)
        self.module = import_module(self.present)
        self.spec = self.module.__spec__
        return self.module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec  # the machinery has put the old name's there
