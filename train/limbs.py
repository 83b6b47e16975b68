"""Fit limb conditionals with Lightning, in one step."""

from torchpose._core.checks import check_rate
from torchpose.io._results import ResultsFolder
from torchpose.learning._fit_files import write_body_model
from torchpose.learning._recipes import LimbStates, fit_limbs
from torchpose.learning._recipes.limbs import check_least_std, limb_summary
from train.body_fit import BodyData, BodyFit

__all__ = ["LimbData", "LimbFit"]


class LimbData(BodyData):
    """Recorded states of all persons, on one body with safe centres (DX 1), at one frame rate.

    Args:
        paths: folders (with their subfolders) or files; `$NAME` stands for a variable of the
            environment.
        persons, held_out, actions, without, fps, axes: see `LimbStates.gather`.

    Raises:
        InputError: see `LimbStates.gather`.
    """

    source = LimbStates

    def __init__(
        self,
        paths: list[str],
        persons: list[str] | None = None,
        held_out: list[str] | None = None,
        actions: list[str] | None = None,
        without: list[str] | None = None,
        fps: float = 60.0,
        axes: str | None = None,
    ) -> None:
        check_rate("fps", fps)
        super().__init__(
            paths=paths, persons=persons, held_out=held_out, actions=actions, without=without,
            fps=fps, axes=axes,
        )  # fmt: skip


class LimbFit(BodyFit):
    """Fits `LimbConditionals` to the states of `LimbData`.

    Logged, with persons held out: `deviation` and `speed` of `LimbSpread`.

    Args:
        least_std: floor of the standard deviations of q_ij, see `fit_limb_conditionals`.
    """

    data_type, what = LimbData, "limb conditionals are"

    def __init__(self, least_std: float = 0.01) -> None:
        super().__init__()
        check_least_std(least_std)
        self.save_hyperparameters()

    def fit_at_once(self) -> dict[str, float]:
        """Fit the conditionals; the fit is repeated where the file is written, since it takes no time."""
        _, held_out = fit_limbs(self.gathered, **self.settings)
        if held_out is None:
            return {"frames": sum(map(len, self.gathered.train))}
        return {"deviation": held_out.deviation, "speed": held_out.speed}

    def write(self, results: ResultsFolder, file: str, pictures: bool, **facts: str) -> str:
        """Write the conditionals."""
        found, held_out = fit_limbs(self.gathered, self.settings["least_std"], **facts)
        return write_body_model(found, limb_summary(found, held_out), results, file)
