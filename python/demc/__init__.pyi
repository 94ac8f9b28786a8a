from os import PathLike
from typing import Any, TypeAlias, TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["Error", "Report", "__version__", "compare", "denoise", "denoise_file", "inspect"]

__version__: str
_Path: TypeAlias = str | bytes | PathLike[str] | PathLike[bytes]
_Float = TypeVar("_Float", np.float32, np.float16)

class Error(RuntimeError): ...

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
    model: _Path = "demc-m",
    *,
    samples: int | np.integer[Any] | None = None,
    threads: int | np.integer[Any] | None = None,
) -> NDArray[_Float]: ...
def denoise_file(
    source: _Path,
    out: _Path,
    model: _Path = "demc-m",
    *,
    overwrite: bool = False,
    view_layer: str | None = None,
    albedo: _Path | None = None,
    normal: _Path | None = None,
    names: dict[str, str] | None = None,
    threads: int | np.integer[Any] | None = None,
) -> Report: ...
def inspect(path: _Path) -> dict[str, Any]: ...
def compare(image: _Path, reference: _Path) -> dict[str, float | None]: ...
