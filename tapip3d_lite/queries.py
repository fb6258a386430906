"""Query points (t, x, y, z): lifted from pixels that were chosen, a grid, a mask, or all pixels of a frame."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from tapip3d_lite.clip import Clip, check_queries, query_frames
from tapip3d_lite.files import regular
from tapip3d_lite.geometry import pixel_grid, unproject
from tapip3d_lite.validate import bools, floats


def has_depth(clip: Clip, pixels: np.ndarray) -> np.ndarray:
    """Which of the pixels (N, 3), rows (t, u, v), have a valid depth: (N,) bool; ValueError for pixels outside the clip."""
    return _with_depth(clip, pixels)[1] > 0


def _with_depth(clip: Clip, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (N, 3), checked, and the depth (N,) at the nearest pixel of each."""
    pixels = floats("pixels", pixels, (None, 3), finite=True)
    t, nearest = query_frames(clip, pixels), np.rint(pixels[:, 1:]).astype(int)
    height, width = clip.size
    outside = ((nearest < 0) | (nearest >= (width, height))).any(-1)
    if outside.any():
        row = int(outside.argmax())
        raise ValueError(
            f"pixels: row {row} = {pixels[row].tolist()} is outside the {width}x{height} image; u must be in [0, {width - 1}], v in [0, {height - 1}]"
        )
    return pixels, clip.depths[t, nearest[:, 1], nearest[:, 0]]


def queries_from_pixels(clip: Clip, pixels: np.ndarray, on_invalid: str = "raise") -> np.ndarray:
    """Lift pixel queries, rows (t, u, v), to world-space queries, float32 rows (t, x, y, z).

    The depth is that of the nearest pixel; (0, 0) is the top-left pixel's centre. With `on_invalid="skip"` rows on
    invalid depth are left out (`has_depth` says which those are).

    Raises:
        ValueError: wrong shape, frame or pixel outside the clip, or rows on invalid depth, which are named.
    """
    if on_invalid not in ("raise", "skip"):
        raise ValueError(f'on_invalid: expected "raise" or "skip", got {on_invalid!r}')
    pixels, depth = _with_depth(clip, pixels)
    lost = np.flatnonzero(depth == 0)
    if len(lost) and (on_invalid == "raise" or len(lost) == len(pixels)):
        listed = ", ".join(f"{row} = {pixels[row].tolist()}" for row in lost[:5]) + ", …" * (len(lost) > 5)
        raise ValueError(
            f"pixels: {len(lost)} of {len(pixels)} rows fall on invalid depth: {listed}; move them, fill the depth, "
            'or leave them out: on_invalid="skip"' + " (which would leave none)" * (len(lost) == len(pixels))
        )
    return _lifted(clip, pixels, depth)


def _lifted(clip: Clip, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Rows (t, x, y, z) of the pixels (N, 3) whose depth (N,) is known."""
    pixels, depth = pixels[depth > 0], depth[depth > 0]
    t = pixels[:, 0].astype(int)
    world = unproject(pixels[:, None, 1:], depth[:, None], clip.intrinsics[t], clip.extrinsics[t])
    return np.concatenate([pixels[:, :1], world[:, 0]], -1)


def grid_queries(clip: Clip, side: int = 16, frame: int = 0, margin: float = 1 / 64) -> np.ndarray:
    """A side x side grid of queries on one frame, without the nodes that fall on invalid depth.

    The outermost nodes keep `margin` times the image width from every border, as in the released code's support grid;
    in images less than twice as high they lie along the middle.
    Rows (t, x, y, z) are float32, in row-major order.

    Raises:
        ValueError: a frame outside the clip, or one without depth at any node.
    """
    return _some(support_queries(clip, side, frame, margin), clip, frame, f"any node of the {side}x{side} grid")


def support_queries(clip: Clip, side: int, frame: int = 0, margin: float = 1 / 64) -> np.ndarray:
    """`grid_queries`, or no rows at all where no node has depth: points that only help others may be missing."""
    if not 1 <= side <= 2**12 or not 0 <= frame < len(clip):
        raise ValueError(
            f"grid_queries: expected side in [1, 4096], a frame in [0, {len(clip) - 1}], got {side=}, {frame=}"
        )
    height, width = clip.size
    inset = [min(width * margin, (length - 1) / 2) for length in (width, height)]
    u, v = (np.linspace(x, length - x, side) for x, length in zip(inset, (width, height), strict=True))
    u, v = np.meshgrid(u, v)
    pixels = np.stack([np.full(u.size, frame), u.ravel(), v.ravel()], -1).astype(np.float32)
    pixels[:, 1:] = np.minimum(pixels[:, 1:], (width - 1, height - 1))
    return _lifted(clip, *_with_depth(clip, pixels))


def dense_queries(clip: Clip, frame: int = 0, mask: np.ndarray | None = None, step: int = 1) -> np.ndarray:
    """Every pixel of a frame that has depth, or of a mask (H, W) in it, bool or 0 and 1: float32 rows (t, x, y, z), row-major.

    With `step` only every so many rows and columns are taken.

    Raises:
        ValueError: a frame outside the clip, a mask of another size, or nothing left: an empty mask, no depth in it.
    """
    if step < 1 or not 0 <= frame < len(clip):
        raise ValueError(f"dense_queries: expected step >= 1, a frame in [0, {len(clip) - 1}], got {step=}, {frame=}")
    chosen = np.zeros(clip.size, bool)
    chosen[step // 2 :: step, step // 2 :: step] = True
    if mask is not None:
        chosen &= bools("mask", mask, clip.size)
    if not chosen.any():
        raise ValueError(f"queries: none left, since the mask is empty at every {step}. row and column; give another")
    uv = pixel_grid(*clip.size, like=np.zeros(0, np.float32))[chosen]
    pixels = np.concatenate([np.full((len(uv), 1), frame, np.float32), uv], 1)
    return _some(_lifted(clip, pixels, clip.depths[frame][chosen]), clip, frame, f"any of the {len(uv)} pixels chosen")


def _some(queries: np.ndarray, clip: Clip, frame: int, where: str) -> np.ndarray:
    if len(queries):
        return queries
    share = (clip.depths[frame] > 0).mean()
    raise ValueError(
        f"queries: none left, since frame {frame} has no valid depth at {where} ({share:.1%} of its pixels have one); "
        "choose another frame or place, or fill the depth"
    )


def resolve_queries(clip: Clip, queries: np.ndarray | None, grid: int = 16) -> np.ndarray:
    """The queries a tracker should follow: those given, else the clip's own, else a grid on the first frame."""
    if queries is not None:
        return check_queries(clip, queries)
    return grid_queries(clip, grid) if clip.queries is None else clip.queries


@dataclass(frozen=True)
class QueryChoice:
    """Which points to track, as the command line asks it: at most one of the first three.

    Attributes:
        pixels: text file with a query a line: frame, u, v.
        mask: image in which the pixels to track are not black.
        dense: track every pixel of a frame that has depth.
        own_queries: use the clip's own queries where it has some and no other grid or frame is asked for.
        grid: queries on a frame, side x side.
        frame: where grid, mask and dense queries are asked.
        step: of mask and dense queries take every so many rows and columns.
        on_invalid: what to do with pixels on invalid depth, raise an error or skip them.
    """

    pixels: Path | None = None
    mask: Path | None = None
    dense: bool = False
    own_queries: bool = True
    grid: int = 16
    frame: int = 0
    step: int = 1
    on_invalid: Literal["raise", "skip"] = "raise"

    def of(self, clip: Clip) -> tuple[np.ndarray, str]:
        """The rows (t, x, y, z) on a clip, and in words which lines were skipped; ValueError also for unreadable files."""
        if (self.pixels is not None) + (self.mask is not None) + self.dense > 1:
            raise ValueError("queries: give one of --pixels, --mask and --dense")
        if self.pixels is not None:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")  # of an empty file
                    rows = np.loadtxt(regular(self.pixels), np.float32, delimiter=",", ndmin=2, encoding="utf-8")
            except (OSError, ValueError, UserWarning) as error:
                raise ValueError(f"{self.pixels}: expected lines of numbers, frame,u,v ({error})") from None
            queries, lost = queries_from_pixels(clip, rows, self.on_invalid), np.flatnonzero(~has_depth(clip, rows))
            return queries, f"; rows {lost.tolist()} on invalid depth skipped" if len(lost) else ""
        if self.mask is not None:
            data = np.fromfile(self.mask, np.uint8) if self.mask.is_file() else np.zeros(0)
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
            if image is None:
                raise ValueError(f"{self.mask}: not a readable image; expected a mask, black where not to track")
            return dense_queries(clip, self.frame, image > 0, self.step), ""
        if self.dense:
            return dense_queries(clip, self.frame, step=self.step), ""
        own = self.own_queries and clip.queries is not None and (self.grid, self.frame) == (16, 0)
        return clip.queries if own else grid_queries(clip, self.grid, self.frame), ""


def near_origin(clip: Clip, shift: np.ndarray | None = None) -> tuple[Clip, np.ndarray]:
    """A far clip, without its points, nearer the world's origin, where float32 resolves it; and the shift (3,) float64 in between.

    That is a multiple of 100 times the depth, rounded to a power of ten: so worlds that differ by one become the same.
    """
    if shift is None:
        grid = 100 * 10.0 ** np.floor(np.log10(np.median(clip.depths[clip.depths > 0]))) if clip.depths.any() else 100.0
        first = clip.extrinsics[0].astype(np.float64)
        shift = grid * np.rint(np.linalg.solve(first[:3, :3], -first[:3, 3]) / grid)
    poses = clip.extrinsics.astype(np.float64)
    poses[:, :3, 3] += poses[:, :3, :3] @ shift
    return replace(clip, extrinsics=poses, queries=None, tracks=None) if shift.any() else clip, shift


def shifted(rows: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Rows (t, x, y, z) in the world of the clip that `near_origin` made, float32."""
    return (rows - np.r_[0, shift]).astype(np.float32)
