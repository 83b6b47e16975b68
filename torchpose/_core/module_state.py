"""Manage the state of modules: registered tensors, what is derived from them, and their precision."""

import functools
import threading
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple, Self, TypeVar, cast, overload
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from torchpose._core.value_checks import values_visible
from torchpose.errors import InputError

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def register_given(module: nn.Module, name: str, value: Tensor | None) -> None:
    """Register a tensor that the caller gave, so that the module owns what it depends on.

    A parameter stays that very parameter, which an optimiser may hold. A tensor with a graph is kept
    as it is, since gradients are to flow through it; it lasts for one backward pass. Anything else is
    copied: state shares no memory with the caller's tensors or with other entries, and a module that is
    made in inference mode keeps what it derives as any other does.

    Args:
        module: that registers it. name: the name of the entry. value: None is registered as an empty entry.
    """
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    elif value is None or value.requires_grad:
        module.register_buffer(name, value)
    else:
        with outside_inference():  # where its versions tell whether what was derived still holds
            own = value.detach().clone(memory_format=torch.contiguous_format)
        module.register_buffer(name, own)


@overload
def wide_or_parameter(value: Tensor | float | Sequence[float]) -> Tensor: ...
@overload
def wide_or_parameter(value: None) -> None: ...
def wide_or_parameter(value: Tensor | float | Sequence[float] | None) -> Tensor | None:
    """Return a float64 tensor; a parameter stays that parameter, and None is None."""
    if value is None or isinstance(value, nn.Parameter):
        return value
    return torch.as_tensor(value, dtype=torch.float64)


class _Mark(NamedTuple):
    """Holds the identity and version of a tensor, by which a later change of its values is noticed."""

    tensor: Tensor
    version: int
    address: int
    dtype: torch.dtype

    @classmethod
    def of(cls, tensor: Tensor) -> Self:
        return cls(tensor, tensor._version, tensor.data_ptr(), tensor.dtype)

    def holds(self, tensor: Tensor) -> bool:
        return (
            tensor is self.tensor
            and tensor._version == self.version
            and tensor.data_ptr() == self.address
            and tensor.dtype == self.dtype
        )


class _Entry(NamedTuple):
    """Holds a derived value with the marks of the tensors that it was derived from."""

    marks: tuple[_Mark, ...]
    value: Any

    def holds(self, given: Sequence[Tensor]) -> bool:
        """Return whether these are the tensors that the value was derived from, as they were then."""
        return len(self.marks) == len(given) and all(
            mark.holds(source) for mark, source in zip(self.marks, given, strict=True)
        )


class _Kept(dict[Hashable, _Entry]):
    """Holds derived values by their names; a class of its own, which shape checks need not look into."""


# Outside the modules: not part of their state, and neither copied nor pickled with them.
_KEPT: "WeakKeyDictionary[nn.Module, _Kept]" = WeakKeyDictionary()


class _Graphs(threading.local):
    """Holds the values derived with a graph while a run goes on in this thread."""

    def __init__(self) -> None:
        self.depth = 0
        self.kept = _Kept()
        self.traced: dict[Hashable, tuple[tuple[Tensor, ...], Any]] = {}


_GRAPHS = _Graphs()


@contextmanager
def one_run(device: torch.device) -> Iterator[None]:
    """Set what holds within one run of a filter: full precision, and graphs that are shared.

    Autocast is off, since covariances do not survive half precision. What is derived with gradients is
    kept while the run lasts and not beyond: its graph is freed by the backward pass, and the next run
    has to build its own.
    """
    with _full_precision(device):
        if torch.compiler.is_dynamo_compiling():
            yield
            return
        _GRAPHS.depth += 1
        try:
            yield
        finally:
            _GRAPHS.depth -= 1
            if _GRAPHS.depth == 0:
                _GRAPHS.kept.clear()
                _GRAPHS.traced.clear()


def _full_precision(device: torch.device) -> AbstractContextManager[Any]:
    try:
        return torch.autocast(device.type, enabled=False)
    except RuntimeError as error:
        raise InputError(
            f'nothing runs on the device "{device}"; move the module to another one, such as "cpu"'
        ) from error


def as_one_run(method: F) -> F:
    """Run a method of a module in `one_run`, on the device of the module's tensors."""

    @functools.wraps(method)
    def run(self: nn.Module, *args: Any, **kwargs: Any) -> Any:
        with one_run(next(self.buffers()).device):
            return method(self, *args, **kwargs)

    return cast(F, run)


def derived(
    module: nn.Module, name: Hashable, sources: tuple[Tensor | None, ...], make: Callable[[], T]
) -> T:
    """Return `make()`, or what it returned before while its sources have not changed.

    A source has changed if it is another tensor, or was written to in place: by an optimiser, by
    `load_state_dict`, by hand. (Writing through `tensor.data` hides from PyTorch, and so from here.)
    Under `torch.compile` nothing is kept, and inside `torch.export` and `torch.func` transforms
    nothing beyond the run.

    Args:
        module: whose value it is; when it goes, so does the value. name: among those of the module.
        sources: tensors that the value depends on. make: computes it from these alone.
    """
    given = tuple(source for source in sources if source is not None)
    name = (name, values_visible())  # what was made without checks is not for those with
    if torch.compiler.is_dynamo_compiling():
        return make()
    compiling = torch.compiler.is_compiling()
    learning = torch.is_grad_enabled() and any(source.requires_grad for source in given)
    kept = _KEPT.get(module)
    if not compiling and not learning and kept is not None:  # most often it holds
        entry = kept.get(name)
        if entry is not None and entry.holds(given):
            return entry.value
    if compiling or any(map(_is_opaque, given)):
        return _kept_in_this_run((id(module), name), given, make) if _GRAPHS.depth else make()
    if learning:
        if not _GRAPHS.depth:
            return make()
        return _kept_in(_GRAPHS.kept, (id(module), name), given, make)
    return _kept_in(_KEPT.setdefault(module, _Kept()), name, given, lambda: _without_graph(make))


def _without_graph(make: Callable[[], T]) -> T:
    """Return `make()` for use anywhere."""
    with torch.inference_mode(False), torch.no_grad():
        return make()


@contextmanager
def outside_inference() -> Iterator[None]:
    """Make tensors that may be kept: those of inference mode could not be used for gradients later."""
    if not torch.is_inference_mode_enabled():
        yield
        return
    with torch.inference_mode(False), torch.no_grad():
        yield


@functools.cache
def index_tensor(rows: tuple[int, ...], device: torch.device) -> Tensor:
    """Return rows as a tensor to index with, the same one each time."""
    with outside_inference():
        return torch.tensor(rows, dtype=torch.long, device=device)


def _kept_in(kept: _Kept, key: Hashable, given: tuple[Tensor, ...], make: Callable[[], T]) -> T:
    entry = kept.get(key)
    if entry is None or not entry.holds(given):
        marks = tuple(_Mark.of(source) for source in given)
        entry = _Entry(marks, make())
        kept[key] = entry
    return entry.value


def _kept_in_this_run(key: Hashable, given: tuple[Tensor, ...], make: Callable[[], T]) -> T:
    """Return `make()`, or what it returned before in this run for the very same tensors."""
    found = _GRAPHS.traced.get(key)
    if found is None or [*map(id, found[0])] != [*map(id, given)]:
        found = _GRAPHS.traced[key] = (given, make())
    return found[1]


def _is_opaque(tensor: Tensor) -> bool:
    """Return whether a tensor has no version or address to compare: of inference mode or a transform."""
    if tensor.is_inference():
        return True
    try:
        tensor.data_ptr()
    except RuntimeError:
        return True
    return False


class _LoadsInOwnPrecision(nn.Module):
    """Converts a state that is loaded to the precision of its tensors, with `assign=True` too."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        for name, own in self.state_dict(prefix=prefix, keep_vars=True).items():
            given = state_dict.get(name)
            if isinstance(own, Tensor) and isinstance(given, Tensor) and own.is_floating_point():
                state_dict[name] = given.to(own.dtype)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class NoHalfModule(_LoadsInOwnPrecision):
    """Refuses half precision, in which covariances are indefinite and cameras lose pixels.

    `.half()` or `.to(torch.bfloat16)` of a model that holds it raise an `InputError`. What is loaded
    takes the precision of the module and of its parts.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        _precision_after(self, fn, torch.float32)
        return super()._apply(fn, recurse)


class OwnPrecisionModule(_LoadsInOwnPrecision):
    """Keeps the precision of its tensors, whatever `.float()`, `.to(dtype)` or a loaded state ask for."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def moved(tensor: Tensor) -> Tensor:
            result = fn(tensor)
            changed = tensor.is_floating_point() and result.dtype != tensor.dtype
            return tensor.to(result.device) if changed else result

        return super()._apply(moved, recurse)


class CpuModule(nn.Module):
    """Stays on the CPU in its own precision, whatever `.to()` asks for: images are measured by OpenCV."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        return self


class WideModule(OwnPrecisionModule):
    """Keeps the precision of its tensors, and has one for what goes in and comes out.

    Covariances whose scales span ten orders of magnitude do not survive single precision. What
    `.float()` or `.to(dtype)` change is `dtype`; `.to(device)` moves everything.

    Attributes:
        dtype: torch.float32 or torch.float64.
    """

    dtype: torch.dtype

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.dtype = _precision_after(self, fn, self.dtype)
        return super()._apply(fn, recurse)


def _precision_after(
    module: nn.Module, fn: Callable[[Tensor], Tensor], dtype: torch.dtype
) -> torch.dtype:
    """Return the precision that `Module._apply` gives to tensors of a dtype; half precision raises."""
    wanted = fn(torch.zeros(1, dtype=dtype)).dtype
    other_parts = f"convert the other parts of the model by themselves, as model.head.to({wanted})"
    return working_precision(f"precision of {type(module).__name__}", wanted, other_parts)


def working_precision(name: str, dtype: torch.dtype, instead: str = "") -> torch.dtype:
    """Return a dtype that filters work in.

    Args:
        name: what has it, for the message. instead: what to do, for the message.

    Raises:
        InputError: neither torch.float32 nor torch.float64.
    """
    if dtype not in (torch.float32, torch.float64):
        raise InputError(
            f"{name} must be torch.float32 or torch.float64, got {dtype}; half precision does not hold "
            "covariances of pixels, metres and radians" + (f"; {instead}" if instead else "")
        )
    return dtype
