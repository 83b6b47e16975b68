"""What the learnt noise of a prior has to be, by its name."""

from torch import Tensor

from torchpose.errors import InputError, check_covariance

__all__ = ["check_noise"]

_STATE = 21
_SIZES = {
    "calibration_scale": ((8,),),
    "calibration_floor": ((8,),),
    "process_cov": ((_STATE,), (_STATE, _STATE)),
    "uniform_weight": ((),),
    "measurement_std": (),
    "gamma": (),
}  # those that are fixed
_MAY_BE_ZERO = ("calibration_floor", "uniform_weight", "process_cov", "gamma")


def check_noise(name: str, value: Tensor) -> None:
    """Check learnt noise that trackers know; other names may hold anything.

    No scale, deviation or variance is negative, and a `process_cov` of 21 x 21 numbers is a covariance.

    Raises:
        InputError: another shape, a number that is not positive. CovarianceError: no covariance.
    """
    kind = next((kind for kind in _SIZES if name == kind or name.startswith(f"{kind}_")), None)
    if kind is None:
        return
    shape = tuple(value.shape)
    if _SIZES[kind] and shape not in _SIZES[kind]:
        sizes = " or ".join(str(list(size)) for size in _SIZES[kind])
        raise InputError(f"noise {name} must have the shape {sizes}, got {list(shape)}")
    if value.ndim == 2 and kind == "process_cov":
        check_covariance(f"noise {name}", value.double())
        return
    low = value < 0 if kind in _MAY_BE_ZERO else value <= 0
    if bool(low.any()):
        least = "at least 0" if kind in _MAY_BE_ZERO else "positive"
        raise InputError(f"noise {name} must be {least}, got {float(value.min()):g}")
