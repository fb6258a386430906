"""A true point in a frame with both of its neighbourhoods, as the figures of lesson 03 draw them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lessons.n03_cells import Cells, track_objects
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import check_drawable
from tapip3d_lite.geometry import project, transform, unproject

NAMES = {"window": "window in the image", "knn": "k-NN in 3D"}


@dataclass(frozen=True)
class Around:
    """A true point in a frame with both of its neighbourhoods.

    Attributes:
        clip: with true tracks.
        frame: frame index.
        cells: of the frame and level.
        xyz: (3,) the point, world.
        uv: (2,) its pixel.
        seen: whether it is visible.
        found: kind of neighbourhood to indices (K,) of its cells, the nearest or the upper left first.
        right: kind to (K,) bool, which of them lie on the point's own object.
    """

    clip: Clip
    frame: int
    cells: Cells
    xyz: np.ndarray
    uv: np.ndarray
    seen: bool
    found: Mapping[str, np.ndarray]
    right: Mapping[str, np.ndarray]

    @classmethod
    def of(
        cls, clip: Clip, objects: np.ndarray, track: int, frame: int, neighbors: int, level: int = 0, stride: int = 4
    ) -> Around:
        """Collect them; arguments as for `two_neighborhoods`."""
        check_drawable(clip, frame=frame)
        if not 0 <= track < clip.tracks.xyz.shape[1]:
            raise ValueError(f"track: expected 0 to {clip.tracks.xyz.shape[1] - 1}, got {track}; choose another")
        xyz = clip.tracks.xyz[frame, track : track + 1]
        uv, _ = project(xyz, clip.intrinsics[frame], clip.extrinsics[frame])
        if not inside_image(clip, np.array([track]))[frame, 0]:
            raise ValueError(f"track {track} is outside the image in frame {frame}; choose another frame or track")
        cells, own = Cells.of(clip, objects, frame, stride << level), track_objects(clip, objects)[track]
        found = {kind: cells.near(xyz, uv, neighbors, kind)[0] for kind in NAMES}
        right = {kind: cells.objects.ravel()[index] == own for kind, index in found.items()}
        return cls(clip, frame, cells, xyz[0], uv[0], bool(clip.tracks.visible[frame, track]), found, right)

    def points(self, kind: str) -> np.ndarray:
        """The neighbours' points (K, 3), camera frame."""
        return transform(self.cells.points.reshape(-1, 3)[self.found[kind]], self.clip.extrinsics[self.frame])

    def pixels(self, kind: str) -> np.ndarray:
        """The neighbours' pixels (K, 2)."""
        return self.cells.uv.reshape(-1, 2)[self.found[kind]]

    def surroundings(self, box: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Points (P, 3), camera frame, and colours (P, 3) of the pixels in a box, near the neighbours in depth."""
        left, top, end, bottom = (round(x) for x in box)
        v, u = (x.ravel() for x in np.mgrid[top : bottom + 1, left : end + 1])
        depth = self.clip.depths[self.frame, v, u]
        limits = np.concatenate([self.points(kind)[:, 2] for kind in NAMES])
        shown = (depth > 0) & (depth > limits.min() - 0.5) & (depth < limits.max() + 0.5)
        uv = np.stack([u, v], -1)[shown].astype(np.float32)
        return unproject(uv, depth[shown], self.clip.intrinsics[self.frame]), self.clip.video[self.frame, v, u][shown]

    def box(self, margin: float = 8) -> tuple[float, ...]:
        """(left, top, right, bottom) of a square of pixels around everything, moved into the image where it fits."""
        places, wide = np.stack([self.uv, *self.pixels("window"), *self.pixels("knn")]), self.clip.size[::-1]
        side = min(np.ptp(places, axis=0).max() + 2 * margin, min(wide) - 1)
        low = np.clip((places.min(0) + places.max(0) - side) / 2, 0, np.array(wide) - 1 - side)
        return (*low, *(low + side))


def inside_image(clip: Clip, tracks: np.ndarray | None = None) -> np.ndarray:
    """(T, N) bool: whether true points lie in the image, seen or hidden; of some tracks, or of all."""
    xyz = clip.tracks.xyz if tracks is None else clip.tracks.xyz[:, tracks]
    uv, z = project(xyz, clip.intrinsics, clip.extrinsics)
    return (z > 0) & (uv >= -0.5).all(-1) & (uv <= np.array(clip.size[::-1]) - 0.5).all(-1)


def frame_inside(clip: Clip, track: int, frame: int) -> int:
    """The frame nearest to `frame` in which a true point lies in the image."""
    frames = np.flatnonzero(inside_image(clip, np.array([track]))[:, 0])
    return int(frames[np.abs(frames - frame).argmin()])
