"""A GPU that is not there: tensors that say they are on ``cuda:0`` and hold their numbers on the CPU.

Operations of tensors on two devices fail as on a GPU, and what crosses between the devices is counted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

GPU = torch.device("cuda:0")
_READS = {
    Tensor.item, Tensor.tolist, Tensor.__bool__, Tensor.__int__, Tensor.__float__, Tensor.__index__, torch.equal,
    Tensor.equal, torch.is_nonzero,
}  # fmt: skip
_OUTSIDE = {Tensor.numpy, Tensor.__array__}
_MOVES = {Tensor.to, Tensor.cpu, Tensor.cuda}
_INDEXED = {Tensor.__getitem__, Tensor.__setitem__}
_BUILT = {torch.tensor, torch.as_tensor}  # of numbers of the host


class FakeTensor(Tensor):
    """A tensor on the fake GPU."""

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _call(func, args, kwargs or {}, Crossings.current)


class Crossings(TorchFunctionMode):
    """Counts, by name of the operation, of what left the fake GPU or came to it while this was active."""

    current: Crossings | None = None

    def __init__(self) -> None:
        super().__init__()
        self.to_host: Counter[str] = Counter()
        self.to_gpu: Counter[str] = Counter()
        self.reads: Counter[str] = Counter()

    def clear(self) -> None:
        """Forget what was counted."""
        for counts in (self.to_host, self.to_gpu, self.reads):
            counts.clear()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _call(func, args, kwargs or {}, self)

    def __enter__(self) -> Crossings:
        Crossings.current = self
        return super().__enter__()  # type: ignore[return-value]

    def __exit__(self, *error: Any) -> None:
        Crossings.current = None
        super().__exit__(*error)


def fake(tensor: Tensor) -> FakeTensor:
    """``tensor`` on the fake GPU."""
    return tensor if isinstance(tensor, FakeTensor) else tensor.as_subclass(FakeTensor)


def _place() -> str:
    frame = sys._getframe(2)
    while frame.f_back is not None and ("/torch/" in frame.f_code.co_filename or frame.f_code.co_filename == __file__):
        frame = frame.f_back
    return f"{frame.f_code.co_filename.rpartition('/')[2]}:{frame.f_code.co_name}"


def _has_list(index: Any) -> bool:
    return any(isinstance(part, list) for part in (index if isinstance(index, tuple) else (index,)))


def _is_gpu(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


def _call(func: Any, args: Any, kwargs: dict[str, Any], seen: Crossings | None) -> Any:
    values = tree_flatten((args, kwargs))[0]
    tensors = [x for x in values if isinstance(x, Tensor)]
    ours = [x for x in tensors if isinstance(x, FakeTensor)]
    with torch._C.DisableTorchFunctionSubclass():
        if ours and func == Tensor.device.__get__:
            return GPU
        if ours and func == Tensor.is_cuda.__get__:
            return True
        if func in _OUTSIDE and ours:
            raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")
        if func in _MOVES:
            return _move(func, args, kwargs, seen)
        if func in _READS and ours and seen is not None:
            seen.reads[_place()] += 1
        on_gpu = bool(ours)
        if "device" in kwargs and kwargs["device"] is not None:
            on_gpu = _is_gpu(kwargs["device"])
            if on_gpu:
                if func in _BUILT and seen is not None:
                    seen.to_gpu[_place()] += 1
                kwargs = {**kwargs, "device": torch.device("cpu")}
        elif ours and any(x.ndim for x in tensors if not isinstance(x, FakeTensor)):
            if func not in _INDEXED:
                raise RuntimeError(f"{func.__name__}: expected all tensors to be on the same device (cuda:0, cpu)")
            if seen is not None:
                seen.to_gpu[_place()] += 1
        if ours and func in _INDEXED and seen is not None and _has_list(args[1]):
            seen.to_gpu[_place()] += 1
        found = func(*args, **kwargs)
    if not on_gpu or isinstance(found, (torch.Size, bool, int, float, str)):
        return found
    return tree_map(lambda x: fake(x) if isinstance(x, Tensor) else x, found)


def _move(func: Any, args: Any, kwargs: dict[str, Any], seen: Crossings | None) -> Any:
    source, *rest = args
    target: torch.device | None = None
    if func is Tensor.cpu:
        target, rest = torch.device("cpu"), []
    elif func is Tensor.cuda:
        target, rest = GPU, []
    else:
        rest = list(rest)
        for index, value in enumerate(rest):
            if isinstance(value, Tensor):
                target = GPU if isinstance(value, FakeTensor) else torch.device("cpu")
                rest[index] = value.as_subclass(Tensor)
            elif isinstance(value, (str, torch.device)):
                target, rest[index] = torch.device(value), torch.device("cpu")
        if kwargs.get("device") is not None:
            target, kwargs = torch.device(kwargs["device"]), {**kwargs, "device": torch.device("cpu")}
    was = isinstance(source, FakeTensor)
    becomes = was if target is None else target.type == "cuda"
    if was != becomes and seen is not None:
        (seen.to_host if was else seen.to_gpu)[_place()] += 1
    plain = source.as_subclass(Tensor) if was else source
    moved = Tensor.to(plain, *rest, **kwargs) if func is Tensor.to else plain
    return fake(moved) if becomes else moved


def to_gpu(module: nn.Module) -> nn.Module:
    """The module with its weights and buffers on the fake GPU, in place."""
    for part in module.modules():
        for name, weight in part._parameters.items():
            if weight is not None:
                part._parameters[name] = nn.Parameter(fake(weight.detach()), weight.requires_grad)
        for name, buffer in part._buffers.items():
            if buffer is not None:
                part._buffers[name] = fake(buffer)
    return module


class _Generator(torch.Generator):
    """A generator of any device, whose numbers are those of the CPU."""

    def __new__(cls, device: Any = "cpu") -> _Generator:
        return super().__new__(cls, "cpu")


@contextmanager
def fake_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[Crossings]:
    """Context in which ``cuda`` is the fake GPU; yields the counts of what crosses."""
    real = torch.Generator
    for module in list(sys.modules.values()):
        if getattr(module, "Generator", None) is real and module is not torch._C:
            monkeypatch.setattr(module, "Generator", _Generator)
    with Crossings() as crossings:
        yield crossings
