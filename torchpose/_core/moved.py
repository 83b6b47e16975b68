"""Keep old names working for one release, with a `DeprecationWarning`: modules, names, arguments.

`_MODULES`, `NAMES` and `ARGUMENTS` are the whole table. All are to go in version 0.3.0.
"""

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

_PACKAGE = Path(__file__).parents[1]
_BETWEEN = {"torchpose", "torch", "importlib"}  # packages between a program and a warning

_MODULES = {
    "": "protocols=evaluation",
    "_core": (
        "io.estimates io.fields=reading io.files io.leftovers=files io.npz=reading io.reading "
        "metric_arguments=value_pairs module_state priors.tensor_file value_checks"
    ),
    "body": "body.body_parameters=_limbs",
    "camera": (
        "body_view=_virtual_camera camera_rig=_rig cli.camera_option=_choice lifting=_projection "
        "projection viewpoints"
    ),
    "demo": "mannequin rendering",
    "demo._rendering": "rendering.portrait=look",
    "evaluation": "protocols.common=_trials protocols.persons=_person_recordings",
    "filters": (
        "filters.base=_recursive_filter filters.frame_weights=_memoryless "
        "filters.gains=_gain_graph filters.gamma=_transition filters.mending=_outputs "
        "filters.particle_options=_particle filters.scan=_shared_gains "
        "filters.survival=_resampling filters.tracks=_mkf"
    ),
    "io._formats": (
        "io.axes io.azure_json=skeleton_files io.bvh_recordings=mocap_files "
        "io.c3d_recordings=mocap_files io.kinect_csv io.kinect_v1=skeleton_files "
        "io.npz_recordings=raw_recording io.ntu_skeleton=skeleton_files io.openpose "
        "io.raw_recording io.units=axes"
    ),
    "learning": (
        "cli.prior_files=_fit_files curation priors.action_fit=_action_spaces "
        "priors.action_recognition=_action_spaces priors.body_card=_model_card "
        "priors.completion=_streamed_em priors.fine_tuning priors.gplvm_fit "
        "priors.gplvm_noise=_manifolds priors.increments=_upper_body_prior_fit priors.model_card "
        "priors.pose_sequences=_manifolds priors.repetitions=_performances priors.samplers "
        "priors.seen_keypoints=_training priors.selection priors.share=_blocks priors.stepwise_em "
        "priors.streamed_em priors.synchronisation=_performances priors.training "
        "priors.usable_samples=_blocks recipes"
    ),
    "math": (
        "body.quaternion_vectors=_rotations filters.geometric_median filters.tree_messages "
        "gaussian priors.em=_mixture_em priors.features=_mixture_steps "
        "priors.start=_mixture_start rotation_gaussians rotations unscented"
    ),
    "measure": (
        "measure.face_memory=_head measure.hand_measurements=_hand_likelihood "
        "measure.hand_settings=_hand_likelihood measure.head_neck=_head "
        "measure.motion=_background measure.torso=_torso_elbows "
        "measure.upper_body=_upper_body_measurer"
    ),
    "metrics": "calibration torchmetrics_adapters",
    "priors": (
        "priors.gmm=_gaussian_mixture priors.prior_noise=_prior_file "
        "priors.upper_body=_upper_body_prior"
    ),
    "priors._actions": (
        "priors.action_bank=bank priors.action_chain=stack priors.action_file "
        "priors.action_gate=gate priors.action_space=space priors.action_stack=stack "
        "priors.part_postures priors.polar_limbs priors.postures"
    ),
    "priors._manifold": (
        "priors.gplvm priors.gplvm_kernel=prediction priors.gplvm_prediction=prediction "
        "priors.manifold_file"
    ),
    "skeleton": "io.landmarks=_mediapipe_landmarks joint_sets priors.neck=_torso torso",
    "upper_body": (
        "arm_filters=_single_poses arm_windows=_windows arms=_estimator cli.pose_csv=_pose_files "
        "collapse=_reading io.bvh=_pose_files measurements=_measured_joints "
        "methods=_estimator_table pose_track process_noise=_single_poses read_out=_fusion "
        "streaming=_live_pose tracking=_upper_body_tracker"
    ),
    "video": (
        "measure.silhouettes person_stream pose_spool=_recording recording "
        "video.base=_source_interface video.body_overlay=_overlay video.live=_live_view "
        "video.pen=_overlay video.probe=_timing video_tracker"
    ),
    "viz": "report viz.action_picture=_model_pictures viz.manifold_picture=_model_pictures",
    "whole_body": (
        "body_poses=_body_track body_tracking=_body_tracker filters.first_pose "
        "filters.pose_search filters.sharpness"
    ),
    "whole_body._filters": (
        "filters.annealed filters.body_frames filters.body_particles filters.constrained "
        "filters.first_order=motion filters.joint_spread=body_particles filters.leg_swap=legs "
        "filters.limb_observations filters.manifold=manifold_regularised filters.posture_gate "
        "filters.redraw=posture_gate filters.root_uncertainty filters.silhouette_filter "
        "filters.sir"
    ),
    "whole_body._silhouettes": (
        "body.limb_batches body.limb_counts body.limb_outlines=outlines body.rectangles=outlines "
        "body.row_intervals body.shape body.silhouette=rendering "
        "body.silhouette_likelihood=likelihood"
    ),
}
"""Present package (without `torchpose.`) to the old paths of modules that are in it now.

A module keeps its file name, with an underscore in a room; one whose name has changed is OLD=NEW. Submodules
follow their package. A module that only became private (`filters.mkf` is `filters._mkf`) does not stand here.
"""


def _present_modules() -> dict[str, str]:
    found = {}
    for home, paths in _MODULES.items():
        private = "" if "._" in f".{home}" else "_"
        for path in paths.split():
            old, _, new = path.partition("=")
            found[old] = f"{home}.{new or private + old.rpartition('.')[2]}".lstrip(".")
    return found


MODULES = _present_modules()
"""Old module to present module, both without `torchpose.`."""

_LABORATORY = ("body.faults", "io.humaneva", "io.humaneva_joints", "rendering.performances")
"""Modules that belong to the benchmarks of a checkout now, beside most of `protocols`."""

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
        "camera._lens": "undistortion_maps",
        "camera._rig": "RigView as_rig",
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
        "measure._face": "FaceTracker FaceTracks",
        "measure._face_detector": "Region",
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


def _is_of_laboratory(old: str) -> bool:
    """Return whether a module went to the benchmarks, as all former protocols but those in `evaluation`."""
    room, _, name = old.removeprefix("torchpose.").partition(".")
    if room == "protocols" and name and f"protocols.{name}" not in MODULES:
        return not (_PACKAGE / "evaluation" / f"_{name}.py").is_file()
    return f"{room}.{name}" in _LABORATORY


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
        for home, names in NAMES.get(package, {}).items()
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
        if _is_of_laboratory(fullname):
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
