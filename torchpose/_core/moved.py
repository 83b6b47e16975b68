"""Old import paths, which work for one release with a `DeprecationWarning`.

`MODULES` and `NAMES` are the whole table. Both are to go in version 0.3.0.
"""

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

__all__ = [
    "MODULES",
    "NAMES",
    "install",
    "moved_from",
    "moved_function",
    "moved_names",
    "present_module",
]

MODULES = {
    "arm_filters": "upper_body.single_poses",
    "arm_windows": "upper_body.windows",
    "arms": "upper_body.arms",
    "body.faults": "whole_body.silhouettes.faults",
    "body.limb_batches": "whole_body.silhouettes.limb_batches",
    "body.limb_counts": "whole_body.silhouettes.limb_counts",
    "body.limb_outlines": "whole_body.silhouettes.limb_outlines",
    "body.quaternion_vectors": "math.quaternion_vectors",
    "body.rectangles": "whole_body.silhouettes.rectangles",
    "body.row_intervals": "whole_body.silhouettes.row_intervals",
    "body.shape": "whole_body.silhouettes.shape",
    "body.silhouette": "whole_body.silhouettes.rendering",
    "body.silhouette_likelihood": "whole_body.silhouettes.likelihood",
    "body_poses": "whole_body.poses",
    "body_tracking": "whole_body.tracker",
    "body_view": "camera.virtual_camera",
    "calibration": "metrics.calibration",
    "camera_rig": "camera.rig",
    "cli.pose_csv": "upper_body.csv",
    "cli.camera_option": "camera.choice",
    "cli.prior_files": "learning.fit_files",
    "collapse": "upper_body.collapse",
    "curation": "learning.curation",
    "filters.annealed": "whole_body.filters.annealed",
    "filters.body_frames": "whole_body.filters.body_frames",
    "filters.body_particles": "whole_body.filters.body_particles",
    "filters.constrained": "whole_body.filters.constrained",
    "filters.first_order": "whole_body.filters.motion",
    "filters.first_pose": "whole_body.first_pose",
    "filters.frame_weights": "filters.memoryless",
    "filters.gains": "filters.gain_graph",
    "filters.geometric_median": "math.geometric_median",
    "filters.joint_spread": "whole_body.filters.body_particles",
    "filters.leg_swap": "whole_body.filters.leg_swap",
    "filters.limb_observations": "whole_body.filters.limb_observations",
    "filters.manifold": "whole_body.filters.manifold",
    "filters.mending": "filters.outputs",
    "filters.particle_options": "filters.particle",
    "filters.pose_search": "whole_body.pose_search",
    "filters.posture_gate": "whole_body.filters.posture_gate",
    "filters.redraw": "whole_body.filters.posture_gate",
    "filters.root_uncertainty": "whole_body.filters.root_uncertainty",
    "filters.scan": "filters.shared_gains",
    "filters.sharpness": "whole_body.sharpness",
    "filters.silhouette_filter": "whole_body.filters.silhouette_filter",
    "filters.sir": "whole_body.filters.sir",
    "filters.tracks": "filters.mkf",
    "filters.tree_messages": "math.tree_messages",
    "gaussian": "math.gaussian",
    "io.axes": "io.formats.axes",
    "io.azure_json": "io.formats.azure_json",
    "io.bvh": "upper_body.bvh",
    "io.bvh_recordings": "io.formats.bvh_recordings",
    "io.c3d_recordings": "io.formats.c3d_recordings",
    "io.estimates": "_core.estimates",
    "io.fields": "_core.fields",
    "io.files": "_core.files",
    "io.humaneva_joints": "io.formats.humaneva_joints",
    "io.kinect_csv": "io.formats.kinect_csv",
    "io.kinect_v1": "io.formats.kinect_v1",
    "io.landmarks": "skeleton.mediapipe_landmarks",
    "io.leftovers": "_core.leftovers",
    "io.npz": "_core.npz",
    "io.npz_recordings": "io.formats.npz_recordings",
    "io.ntu_skeleton": "io.formats.ntu_skeleton",
    "io.openpose": "io.formats.openpose",
    "io.raw_recording": "io.formats.raw_recording",
    "io.reading": "_core.reading",
    "io.units": "io.formats.units",
    "joint_sets": "skeleton.joint_sets",
    "lifting": "camera.lifting",
    "mannequin": "demo.mannequin",
    "measure.silhouettes": "video.silhouettes",
    "measurements": "upper_body.measurements",
    "methods": "upper_body.methods",
    "metric_arguments": "_core.arguments",
    "module_state": "_core.module_state",
    "person_stream": "video.person_stream",
    "pose_spool": "video.pose_spool",
    "pose_track": "upper_body.pose_track",
    "priors.action_bank": "priors.actions.bank",
    "priors.action_chain": "priors.actions.chain",
    "priors.action_file": "priors.actions.file",
    "priors.action_fit": "learning.action_spaces",
    "priors.action_gate": "priors.actions.gate",
    "priors.action_recognition": "learning.action_recognition",
    "priors.action_space": "priors.actions.space",
    "priors.action_stack": "priors.actions.stack",
    "priors.body_card": "learning.body_card",
    "priors.completion": "learning.completion",
    "priors.em": "math.mixture_em",
    "priors.features": "math.mixture_features",
    "priors.fine_tuning": "learning.fine_tuning",
    "priors.gmm": "priors.gaussian_mixture",
    "priors.gplvm": "priors.manifold.gplvm",
    "priors.gplvm_fit": "learning.gplvm_fit",
    "priors.gplvm_kernel": "priors.manifold.prediction",
    "priors.gplvm_noise": "learning.manifolds",
    "priors.gplvm_prediction": "priors.manifold.prediction",
    "priors.increments": "learning.increments",
    "priors.manifold_file": "priors.manifold.file",
    "priors.model_card": "learning.model_card",
    "priors.neck": "skeleton.neck",
    "priors.part_postures": "priors.actions.part_postures",
    "priors.polar_limbs": "priors.actions.polar_limbs",
    "priors.pose_sequences": "learning.manifolds",
    "priors.postures": "priors.actions.postures",
    "priors.repetitions": "learning.performances",
    "priors.samplers": "learning.samplers",
    "priors.seen_keypoints": "learning.seen_keypoints",
    "priors.selection": "learning.selection",
    "priors.share": "learning.blocks",
    "priors.start": "math.mixture_start",
    "priors.stepwise_em": "learning.stepwise_em",
    "priors.streamed_em": "learning.streamed_em",
    "priors.synchronisation": "learning.performances",
    "priors.tensor_file": "_core.tensor_file",
    "priors.training": "learning.training",
    "priors.usable_samples": "learning.blocks",
    "process_noise": "upper_body.process_noise",
    "projection": "camera.projection",
    "protocols": "evaluation",
    "read_out": "upper_body.fusion",
    "recipes": "learning.recipes",
    "recording": "video.recording",
    "rendering": "demo.rendering",
    "report": "viz.report",
    "rotation_gaussians": "math.rotation_gaussians",
    "rotations": "math.rotations",
    "streaming": "upper_body.live",
    "torchmetrics_adapters": "metrics.torchmetrics_adapters",
    "torso": "skeleton.torso",
    "tracking": "upper_body.tracker",
    "unscented": "math.unscented",
    "value_checks": "_core.value_checks",
    "video_tracker": "video.tracker",
    "viewpoints": "camera.viewpoints",
}
"""Old module to present module, both without `torchpose.`; submodules follow their package."""

LABORATORY = frozenset(
    [
        "bend",
        "bend_actions",
        "bend_data",
        "bend_occlusion",
        "bend_pictures",
        "bend_runs",
        "bend_tables",
        "bend_trackees",
        "body_models",
        "gaps",
        "one_tables",
        "root_uncertainty",
        "root_uncertainty_pictures",
        "root_uncertainty_runs",
        "root_uncertainty_search",
        "root_uncertainty_tables",
        "root_uncertainty_trackees",
        "signer",
        "silhouette",
        "silhouette_data",
        "silhouette_humaneva",
        "silhouette_pictures",
        "silhouette_report",
        "silhouette_runs",
        "silhouette_tables",
        "silhouette_trackees",
        "ub_one",
        "ub_people",
        "uncommon_poses",
    ]
)
"""Modules of `torchpose.protocols` that are benchmarks of a checkout now, not part of the package."""

NAMES: dict[str, dict[str, str]] = {
    "torchpose.body": {
        "whole_body": (
            "PreparedSilhouettes SilhouetteCounts bidirectional count_pixels fit_radii "
            "intersection_over_union prepare_silhouettes render render_limbs"
        ),
    },
    "torchpose.camera": {
        "camera.lifting": "arm_in_body_frame arm_in_camera_frame join_arms pixel_covariances",
        "camera.projection": "check_intrinsics intrinsics map_pixel_covariance",
        "camera.rig": "RigView as_rig undistortion_maps",
        "camera.viewpoints": "PAPER_VIEWS Viewpoints",
        "math.rotations": (
            "ROTATION_ORDERS RotationOrder euler_to_matrix matrix_to_euler rotvec_to_matrix"
        ),
    },
    "torchpose.demo": {
        "demo.mannequin": "ANGLE_LIMITS BodyAngles BodySize angles_to_joints",
        "demo.performer": "hip_sway minimum_jerk performer_angles stage sway",
    },
    "torchpose.filters": {
        "whole_body": (
            "AnnealedParticleFilter BodyFilterState BodyTrack ConstrainedParticleFilter "
            "FirstPose ManifoldParticleFilter RootUncertaintyTracker SIRParticleFilter "
            "SilhouetteParticleFilter ValidationSequence constant_velocity_std "
            "default_step_std find_first_pose find_pose fit_sharpness motion_std"
        ),
    },
    "torchpose.io": {
        "_core.files": "atomic_path check_output_folder read_npz require_file write_npz",
        "io.formats.axes": "AXES",
    },
    "torchpose.math": {
        "math.gaussian": (
            "Gain condition kalman_correct kalman_gain least_exponent marginal "
            "mended_cholesky product safe_cholesky symmetrise"
        ),
        "math.mixture_em": "FitReport MixtureParameters SufficientStatistics e_step m_step",
        "math.quaternion_vectors": (
            "cross_matrix minimal_rotation quaternion_to_vector vector_to_quaternion "
            "within_unit_ball"
        ),
        "math.rotation_gaussians": (
            "left_matrix quaternion_moments right_matrix sigma_quaternions"
        ),
        "math.rotations": "ROTATION_ORDERS RotationOrder",
        "math.unscented": "DIRECTIONS Directions floor_eigenvalues moments",
    },
    "torchpose.measure": {
        "measure.association": "AssociationState HandAssociation",
        "measure.background": "BackgroundModel",
        "measure.brightness_background": "BrightnessBackground PixelKind",
        "measure.edges": "Segments edge_map find_segments limb_votes",
        "measure.face": "FaceTracks Region",
        "measure.hand_measurements": "HandMeasurements",
        "measure.hands": "HandState",
        "measure.head_neck": "FACE_OFFSETS",
        "measure.mean_shift": "MeanShift",
        "measure.mean_shift_hands": "MeanShiftHandState",
        "measure.mediapipe": "PoseLandmarks",
        "measure.persons": "PersonRegister Persons",
        "measure.skin": "SkinState rgb_to_lab",
        "measure.skin_mixture": "SkinMixtureState",
        "measure.torso": "TorsoElbows clothes_likelihood elbows_from_torso",
        "measure.upper_body": "FrameMeasurements MEASURED MeasurerState",
        "video.silhouettes": "SilhouetteMeasurer fit_view read_silhouettes",
    },
    "torchpose.metrics": {
        "metrics.calibration": "Coverage chi2_cdf chi2_quantile mahalanobis_squared",
        "metrics.poses": (
            "ALIGN_JOINTS ARM_LIMBS Alignment ErrorSummary PCP RigidMotion limb_hits share_below"
        ),
    },
    "torchpose.priors": {
        "learning": (
            "TRAINING_VIEWS arm_sources collect_poses fit_upper_body_prior model_card "
            "write_model_card"
        ),
        "math.mixture_em": (
            "FitReport MixtureParameters SufficientStatistics e_step expectation_maximisation "
            "m_step"
        ),
        "skeleton.neck": (
            "NeckFraction NeckOffset learn_neck_fraction learn_neck_offset place_neck"
        ),
    },
    "torchpose.skeleton": {
        "skeleton.joint_sets": "canonical_names",
        "skeleton.neck": (
            "NeckFraction NeckOffset learn_neck_fraction learn_neck_offset place_neck"
        ),
        "skeleton.upper_body": (
            "ARM_JOINTS BONES NECK_KINDS OTHER_SIDE UpperBodyMap measure_neck_kind scale_bones"
        ),
    },
    "torchpose.viz": {
        "viz.prior_pictures": "plot_log_likelihood",
    },
    "torchpose.video.recording": {"video.recording": "Recording=TrackedRecording"},
}
"""Names that a package or module had: present home (without `torchpose.`) to the names in it.

A name that has changed is OLD=NEW.
"""


def present_module(old: str) -> str | None:
    """Return the full present name of a module by its old full name, or None if it did not move."""
    parts = old.split(".")[1:]
    for length in range(len(parts), 0, -1):
        home = MODULES.get(".".join(parts[:length]))
        if home is not None:
            return ".".join(["torchpose", home, *parts[length:]])
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
    """Return present home, old name and present name of everything that has left a package."""
    return [
        (home, old, new or old)
        for home, names in NAMES[package].items()
        for old, _, new in (name.partition("=") for name in names.split())
    ]


def moved_function(old: str, new: str) -> Callable[..., Any]:
    """Return the function that a method has become, by its full name, and warn who called the method."""
    _warn(old, new)
    home, _, name = new.rpartition(".")
    function: Callable[..., Any] = getattr(import_module(home), name)
    return function


def install() -> None:
    """Let `import` find modules by their old names."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OldNames())


def _warn(old: str, new: str) -> None:
    """Warn where the caller of the caller stands; frames of the import machinery do not count."""
    warnings.warn(
        f"{old} is {new} now; the old one goes with version 0.3.0",
        DeprecationWarning,
        stacklevel=3,
    )


class _OldNames:
    """Finds a module by its old name, and gives the present one in its place.

    A finder as `sys.meta_path` has them. The base classes of `importlib.abc` are not needed for that, and
    take as long to import as half of torchpose.
    """

    def find_spec(
        self, fullname: str, path: object = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not fullname.startswith("torchpose."):
            return None
        if fullname.startswith("torchpose.protocols.") and fullname.split(".")[2] in LABORATORY:
            raise ModuleNotFoundError(
                f"{fullname} is no part of the package any more; from a checkout of torchpose it is "
                "run by python -m benchmarks.NAME (docs/benchmarks.md)",
                name=fullname,
            )
        present = present_module(fullname)
        if present is None:
            return None
        return ModuleSpec(fullname, _Alias(present))  # type: ignore[arg-type]  # no `importlib.abc.Loader`


class _Alias:
    """Loads the present module, and leaves it as it was."""

    def __init__(self, present: str) -> None:
        self.present = present

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        _warn(spec.name, self.present)
        self.module = import_module(self.present)
        self.spec = self.module.__spec__
        return self.module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec  # the machinery has put the old name's there
