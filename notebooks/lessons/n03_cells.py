"""Which neighbours lie on the right object: cells of a frame's cloud with their objects, and distances to silhouettes.

Paper: section 3.2 (k-NN in 3D) and the table on neighbourhoods (against a fixed window in 2D). The claim is measured here without any
tracker: the query stands on a known object, the simulator knows the object of every cell, and so the share of a
neighbourhood that lies on the query's own object is a plain count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from lessons.n03_search import filled, stand_ins
from tapip3d_lite.clip import Clip
from tapip3d_lite.geometry import point_map, project
from tapip3d_lite.model.cloud import Level, nearest_exact
from tapip3d_lite.model.config import TrackerConfig
from tapip3d_lite.model.neighbors import KNearest
from tapip3d_lite.variants.window2d import WindowNeighborhood

KINDS = {"window": WindowNeighborhood, "knn": KNearest}


@dataclass(frozen=True)
class Cells:
    """One level of one frame's cloud, with objects in place of features.

    Attributes:
        points: (h, w, 3) world.
        objects: (h, w) int, -1 where there is no depth.
        uv: (h, w, 2), the pixel that gives each cell its point.
        size: (H, W) of the image.
    """

    points: np.ndarray
    objects: np.ndarray
    uv: np.ndarray
    size: tuple[int, int]

    @classmethod
    def of(cls, clip: Clip, objects: np.ndarray, frame: int, stride: int = 4) -> Cells:
        """The cells that a tracker with this stride has in a frame.

        Args:
            clip: T frames.
            objects: (T, H, W) int, from `simulate.object_maps`.
            frame: which one.
            stride: pixels per cell; level l of a tracker has its own stride times 2^l.

        Raises:
            ValueError: objects of another shape than the clip's depths, or a stride that leaves no cell.
        """
        if objects.shape != clip.depths.shape:
            raise ValueError(
                f"objects: expected {clip.depths.shape} as the clip's depths, got {objects.shape}; film the same recording"
            )
        if not 1 <= stride <= min(clip.size):
            raise ValueError(f"stride: expected 1 to {min(clip.size)} pixels, got {stride}; lower the level")
        rows, columns = (nearest_exact(n, n // stride, torch.device("cpu")).numpy() for n in clip.size)
        picked = np.ix_(rows, columns)
        points = point_map(clip.depths[frame], clip.intrinsics[frame], clip.extrinsics[frame])[picked]
        uv = np.stack(np.meshgrid(columns, rows), -1)
        objects = np.where(clip.depths[frame] > 0, objects[frame], -1)
        return cls(points.astype(np.float32), objects[picked], uv, clip.size)

    def near(
        self, xyz: np.ndarray, uv: np.ndarray, count: int, kind: str = "knn", by: Callable | None = None
    ) -> np.ndarray:
        """Neighbourhoods as the tracker's own modules collect them, leaving out cells that have no depth.

        Args:
            xyz: (N, 3) world.
            uv: (N, 2), where this frame's camera sees them.
            count: K.
            kind: `"knn"` or `"window"`.
            by: an answer to `03.knn` or `03.window`, in place of the tracker's module; not for windows whose K is no square.

        Returns:
            (N, K) int64 into the h * w cells.

        Raises:
            ValueError: unknown kind, or more neighbours than cells.
        """
        if kind not in KINDS:
            raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
        if by is not None and (kind == "knn" or round(count**0.5) ** 2 == count):
            return self._found(xyz, uv, count, kind, by)
        points = torch.from_numpy(self.points)[None, None]
        valid = torch.from_numpy(self.objects >= 0)[None, None]
        level = Level(points.new_zeros(1, 1, *self.objects.shape, 1), points, valid)
        config = TrackerConfig.preset("paper", neighbors=count, levels=1, exclude_invalid=True)
        # Centred on the cell whose own pixel is nearest: the fairest window, half a cell off the features' convention.
        at = level.cells(torch.as_tensor(uv + 0.5, dtype=torch.float32)[None, None], self.size) - 0.5
        coords = torch.as_tensor(xyz, dtype=torch.float32)[None, None]
        return KINDS[kind](config)(level, coords, at).indices[0, 0].numpy()

    def _found(self, xyz: np.ndarray, uv: np.ndarray, count: int, kind: str, by: Callable) -> np.ndarray:
        valid, shape = (self.objects >= 0).ravel(), self.objects.shape
        if kind == "knn":
            return filled(by(np.float32(xyz), self.points.reshape(-1, 3), count, valid), valid)
        centers = (uv + 0.5) * np.array(shape[::-1]) / np.array(self.size[::-1]) - 0.5
        return np.stack([stand_ins(by(center, round(count**0.5), shape), valid) for center in centers])

    def right(self, indices: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Share (N,) of neighbours (N, K) that lie on the query's own object (N,)."""
        return (self.objects.ravel()[indices] == np.asarray(own)[:, None]).mean(-1)


def silhouettes(objects: np.ndarray, depth: np.ndarray, gap: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """How far every pixel is from the nearest silhouette of its object, and what lies there.

    Args:
        objects: (H, W) int.
        depth: (H, W) z-depth; 0 (the sky) counts as endlessly far.
        gap: scene units; where depth jumps by more from one pixel to the next, one object hides another.

    Returns:
        Distance (H, W) in pixels, 0 for pixels that touch another object, inf where there is only one object;
        and (H, W) bool: whether that silhouette hides something (else two objects touch there).
    """
    touches, hides = np.zeros(objects.shape, bool), np.zeros(objects.shape, bool)
    z = np.where(depth > 0, depth, 1e6)
    for axis in (0, 1):
        one, other = (slice(1, None), slice(None, -1)) if axis == 0 else (np.s_[:, 1:], np.s_[:, :-1])
        edge = objects[one] != objects[other]
        jump = edge & (np.abs(z[one] - z[other]) > gap)
        for side in (one, other):
            touches[side] |= edge
            hides[side] |= jump
    if not touches.any():
        return np.full(objects.shape, np.inf, np.float32), hides
    distance, labels = cv2.distanceTransformWithLabels(
        (~touches).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    kind = np.zeros(labels.max() + 1, bool)
    kind[labels[touches]] = hides[touches]
    return distance, kind[labels]


def track_objects(clip: Clip, objects: np.ndarray) -> np.ndarray:
    """The object (N,) that each track of a clip lies on, read from objects (T, H, W) at the pixel of its query."""
    t = clip.tracks.queries[:, 0].astype(int)
    uv, _ = project(clip.tracks.queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t])
    u, v = np.rint(uv[:, 0]).astype(int).T
    return objects[t, v, u]
