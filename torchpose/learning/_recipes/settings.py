"""Name the settings of the upper-body recipe, for functions that hand them on."""

from typing import TypedDict

from torchpose.priors._window import WindowLayout


class RecipeSettings(TypedDict, total=False):
    """The fields of `UpperBodyRecipe` but for the first ones that `fit_kinect_prior` names itself."""

    n_samples: int
    pose_steps: int
    pose_tol: float
    window_components: int | None
    window_samples: int | None
    window_steps: int
    causal: WindowLayout
    full: WindowLayout
    body_size: float
    bone_lengths: float
    mirror_share: float
    calibration_folds: int
    drawn_pieces: int
    camera_matrix: tuple[float, float, float, float]
    rotation_order: str
    neck: str | None
    mirror: bool
    nose_as_head: bool
