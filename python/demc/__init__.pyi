from os import PathLike
from typing import Any, TypedDict, TypeVar, type_check_only

import numpy as np
from numpy.typing import NDArray

__all__ = ["Error", "__version__", "compare", "denoise", "denoise_file", "inspect"]

__version__: str
_Float = TypeVar("_Float", np.float32, np.float16)

class Error(RuntimeError): ...

# What `denoise_file` returns; the module itself has no such name.
@type_check_only
class Report(TypedDict):
    view_layer: str
    width: int
    height: int
    seconds: float
    repaired: dict[str, int]
    notes: list[str]

def denoise(
    color: NDArray[_Float],
    albedo: NDArray[np.float32] | NDArray[np.float16] | None = None,
    normal: NDArray[np.float32] | NDArray[np.float16] | None = None,
    model: str | PathLike[str] = "demc-m",
    *,
    samples: int | None = None,
    threads: int | None = None,
) -> NDArray[_Float]: ...
def denoise_file(
    source: str | PathLike[str],
    out: str | PathLike[str],
    model: str | PathLike[str] = "demc-m",
    *,
    overwrite: bool = False,
    view_layer: str | None = None,
    albedo: str | PathLike[str] | None = None,
    normal: str | PathLike[str] | None = None,
    names: dict[str, str] | None = None,
    threads: int | None = None,
) -> Report: ...
def inspect(path: str | PathLike[str]) -> dict[str, Any]: ...
def compare(image: str | PathLike[str], reference: str | PathLike[str]) -> dict[str, float | None]: ...
