"""The type checker that `tests/conftest.py` hands to jaxtyping."""

import inspect
from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeDecorHintPep673Exception

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float


def check_after_call(function: Callable) -> Callable:
    """Check annotated shapes of arguments and results once the function has returned.

    jaxtyping checks twice, the arguments alone before the call and everything after it. The first
    check is left out, so that a function can refuse bad input with its own typed error; one that
    takes a wrong shape without a word still fails.
    """
    before_call = inspect.isfunction(function) and (
        inspect.signature(function).return_annotation is Any
    )
    if before_call:
        return function
    try:
        return _beartype(function)
    except BeartypeDecorHintPep673Exception:  # it takes `Self` only where it decorates the class
        return function
