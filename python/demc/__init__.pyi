from os import PathLike
from typing import Any, Literal, TypeAlias, TypedDict, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

__all__ = ["Error", "Report", "__version__", "compare", "denoise", "denoise_file", "inspect", "models"]

__version__: str
_Path: TypeAlias = str | bytes | PathLike[str] | PathLike[bytes]
_Float = TypeVar("_Float", np.float32, np.float16)
_Share = TypeVar("_Share", np.float32, np.float16)
_Guide: TypeAlias = NDArray[np.float32] | NDArray[np.float16] | None

class Error(RuntimeError): ...

class Report(TypedDict):
    view_layer: str
    width: int
    height: int
    samples: int | None
    was_denoised: bool
    expected_error: float | None
    seconds: float
    repaired: dict[str, int]
    notes: list[str]

@overload
def denoise(
    color: NDArray[_Float],
    albedo: _Guide = None,
    normal: _Guide = None,
    model: _Path = "demc-m",
    *,
    alpha: None = None,
    samples: int | np.integer[Any] | None = None,
    threads: int | np.integer[Any] | None = None,
) -> NDArray[_Float]: ...
@overload
def denoise(
    color: NDArray[_Float],
    albedo: _Guide = None,
    normal: _Guide = None,
    model: _Path = "demc-m",
    *,
    alpha: NDArray[_Share],
    samples: int | np.integer[Any] | None = None,
    threads: int | np.integer[Any] | None = None,
) -> tuple[NDArray[_Float], NDArray[_Share]]: ...
def denoise_file(
    source: _Path,
    out: _Path,
    model: _Path = "demc-m",
    *,
    overwrite: bool = False,
    view_layer: str | None = None,
    layer: str | None = "Denoised",
    passes: bool = False,
    alpha: Literal["auto", "denoise", "keep"] = "auto",
    confidence: bool = False,
    albedo: _Path | None = None,
    normal: _Path | None = None,
    names: dict[str, str] | None = None,
    threads: int | np.integer[Any] | None = None,
) -> Report: ...
def inspect(path: _Path) -> dict[str, Any]: ...
def models() -> list[dict[str, Any]]: ...
def compare(
    image: _Path,
    reference: _Path,
    *,
    view_layer: str | None = None,
    layer: str | None = None,
    reference_layer: str | None = None,
) -> dict[str, float | None]: ...
