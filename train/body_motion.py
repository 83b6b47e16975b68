"""Fit how bodies move with Lightning, in one step."""

from dataclasses import asdict

from torchpose._core.checks import check_rate
from torchpose.io._results import ResultsFolder
from torchpose.learning._body_motion_fit import BodyMotionRecipe
from torchpose.learning._fit_files import write_body_model
from torchpose.learning._recipes import RecordedMotion, fit_motion
from torchpose.learning._recipes.body_motion import motion_summary
from train.body_fit import BodyData, BodyFit

__all__ = ["BodyMotionData", "BodyMotionFit"]


class BodyMotionData(BodyData):
    """The motion of all persons on the articulation that is tracked.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        persons, held_out, actions, without, fps, axes: see `RecordedMotion.gather`.

    Raises:
        InputError: see `RecordedMotion.gather`.
    """

    source = RecordedMotion

    def __init__(
        self,
        paths: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        actions: list[str] | None = None,
        without: list[str] | None = None,
        fps: float = 30.0,
        axes: str | None = None,
    ) -> None:
        check_rate("fps", fps)
        super().__init__(
            paths=paths, persons=persons, held_out=held_out, actions=actions, without=without,
            fps=fps, axes=axes,
        )  # fmt: skip


class BodyMotionFit(BodyFit):
    """Fits a `BodyMotion` to the motion of `BodyMotionData`.

    Logged, with persons held out: `acceleration` and `log_density` of `MotionSpread`.

    Args:
        n_components, n_samples, covariance_floor, acceleration_scale, least_shift, pull_time, seed: see
            `BodyMotionRecipe`.
    """

    data_type, what = BodyMotionData, "the motion of bodies is"

    def __init__(
        self,
        n_components: int = BodyMotionRecipe.n_components,
        n_samples: int = BodyMotionRecipe.n_samples,
        covariance_floor: float = BodyMotionRecipe.covariance_floor,
        acceleration_scale: float = BodyMotionRecipe.acceleration_scale,
        least_shift: float = BodyMotionRecipe.least_shift,
        pull_time: float = BodyMotionRecipe.pull_time,
        seed: int = BodyMotionRecipe.seed,
    ) -> None:
        super().__init__()
        self._recipe = BodyMotionRecipe(
            n_components,
            n_samples,
            covariance_floor,
            acceleration_scale,
            least_shift,
            pull_time,
            seed,
        )
        self.save_hyperparameters(asdict(self._recipe))

    def fit_at_once(self) -> dict[str, float]:
        """Fit the prior; the fit is repeated where the file is written, since it takes little time."""
        _, held_out = fit_motion(self.gathered, self._recipe)
        if held_out is None:
            return {"frames": sum(len(s.residual) for s in self.gathered.train)}
        return {"acceleration": held_out.acceleration, "log_density": held_out.log_density}

    def write(self, results: ResultsFolder, file: str, pictures: bool, **facts: str) -> str:
        """Write the prior."""
        found, held_out = fit_motion(self.gathered, self._recipe, **facts)
        return write_body_model(found, motion_summary(found, held_out), results, file)
