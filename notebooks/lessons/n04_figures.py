"""Pictures of two bags of lesson 04: where their cells lie in two images, and who looks at whom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, check_drawable, draw_image, label_axes
from tapip3d_lite.geometry import project
from tapip3d_lite.recorder import LevelRecord, StepRecord

OWN, SUPPORT, CONTEXT = "#e69f00", "#0072b2", "#d55e00"  # of the palette of Okabe and Ito
MARKS = {SUPPORT: "o", CONTEXT: "s"}
WAYS = ("support looks at context", "context looks at support")


def cell_centers(indices: np.ndarray, grid: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Pixels (..., 2) = (u, v) in images (H, W) that give the cells with these numbers their points."""
    rows, columns = np.divmod(np.asarray(indices), grid[1])
    picked = ((c + 0.5) * n / m for c, n, m in ((columns, size[1], grid[1]), (rows, size[0], grid[0])))
    return np.stack([np.floor(x) for x in picked], -1)


@dataclass(frozen=True)
class AttentionPair:
    """Two neighbourhoods of one track in the last update of a window: what `two_bags` and `who_looks_where` draw.

    Attributes:
        clip: the clip.
        record: one level of that update.
        frames: of the support and of the context.
        row: the context's frame, counted in the window.
        column: the track, counted among the recorded ones.
        query: (2,) pixel of the query in its own frame.
        grid: (h, w) of the level.
    """

    clip: Clip
    record: LevelRecord
    frames: tuple[int, int]
    row: int
    column: int
    query: np.ndarray
    grid: tuple[int, int]

    @classmethod
    def of(
        cls,
        clip: Clip,
        steps: Sequence[StepRecord],
        queries: np.ndarray,
        grids: Sequence[tuple[int, int]],
        track: int = 0,
        frame: int = 0,
        level: int = 0,
    ) -> AttentionPair:
        """Find a track, frame and level in a forward pass that was recorded.

        Args:
            clip: the clip.
            steps: of the recorder.
            queries: (N, 4) that were tracked.
            grids: (h, w) of each level, `config.grid_sizes`.
            track: row of the queries.
            frame: of the context; the last window that contains it counts.
            level: of the cloud.

        Raises:
            ValueError: nothing was recorded there.
        """
        check_drawable(clip, frame=frame)
        found = [s for s in steps if s.start <= frame < s.start + len(s.xyz) and track in s.columns]
        if not found:
            raise ValueError(f"frame: expected one in which track {track} was recorded, got {frame}; take a later one")
        step, start = found[-1], int(queries[track, 0])
        uv, _ = project(queries[track : track + 1, 1:], clip.intrinsics[start], clip.extrinsics[start])
        place = step.columns.index(track)
        return cls(clip, step.levels[level], (start, frame), frame - step.start, place, uv[0], tuple(grids[level]))

    @property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of the tokens: the query, then the support's cells (1 + K, 2); and the context's cells (K, 2)."""
        indices = self.record.support.indices[self.column, 1:], self.record.near.indices[self.row, self.column]
        support, context = (cell_centers(i.numpy(), self.grid, self.clip.size) for i in indices)
        return np.concatenate([self.query[None], support]), context

    def weights(self, way: str) -> np.ndarray:
        """How tokens look at each other in one of the two `WAYS`: (1 + K, K) or (K, 1 + K).

        Raises:
            ValueError: no such way, or a tracker whose context is not `n2n`.
        """
        if way not in WAYS:
            raise ValueError(f"way: expected one of {', '.join(WAYS)}; got {way!r}")
        looks = self.record.support_from_context if way == WAYS[0] else self.record.context_from_support
        if looks is None:
            raise ValueError("record: expected a tracker with context='n2n'; this one has no attention between bags")
        return looks[self.row, self.column].numpy()


def two_bags(pair: AttentionPair) -> Figure:
    """The cells of both bags in their images, and both bags of offsets over each other, seen along the world's y."""
    figure = Figure(figsize=(10.2, 2.9), layout="constrained")
    *images, ax = figure.subplots(1, 3)
    for image, frame, where, color in zip(images, pair.frames, pair.places, (SUPPORT, CONTEXT), strict=True):
        name = "support" if color == SUPPORT else "context"
        _crop(image, pair.clip, frame, where, f"{name}: frame {frame}")
        image.scatter(*where.T, s=30, color=color, marker=MARKS[color], edgecolors="white", linewidths=0.6)
    record = pair.record
    image_star, star = images[0], {"marker": "*", "s": 110, "color": OWN, "edgecolors": "white", "zorder": 5}
    image_star.scatter(*pair.query, **star)
    bags = record.support.offsets[pair.column, 1:], record.near.offsets[pair.row, pair.column]
    for offsets, color, name in zip(bags, (SUPPORT, CONTEXT), ("support", "context"), strict=True):
        style = {"s": 26, "color": color, "marker": MARKS[color], "alpha": 0.8, "linewidths": 0}
        ax.scatter(*offsets[:, [0, 2]].numpy().T, label=name, **style)
    ax.scatter(0, 0, label="centre of both", **star)
    label_axes(ax, "offset in z (normalised)", "offset in x (normalised)")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("both bags, from their centres", fontsize=9, color=INK)
    figure.legend(*ax.get_legend_handles_labels(), fontsize=8, frameon=False, loc="outside right center")
    return figure


def who_looks_where(pair: AttentionPair, token: int = 0, way: str = WAYS[0]) -> Figure:
    """One token's attention as lines between two images, and the whole matrix beside them.

    Args:
        pair: two neighbourhoods.
        token: which token looks; of the support, 0 is the query itself.
        way: one of `WAYS`.

    Raises:
        ValueError: a token that the bag does not have.
    """
    weights, (support, context) = pair.weights(way), pair.places
    if not 0 <= token < len(weights):
        raise ValueError(f"token: expected 0 to {len(weights) - 1} in this bag, got {token}; choose another")
    figure = Figure(figsize=(9.6, 3.3), layout="constrained")
    left, right, matrix = figure.subplots(1, 3)
    for ax, frame, where, name in zip(
        (left, right), pair.frames, (support, context), ("support", "context"), strict=True
    ):
        _crop(ax, pair.clip, frame, where, f"{name}: frame {frame}")
        ax.scatter(*where.T, s=10, facecolors="none", edgecolors="white", linewidths=0.7)
    if way == WAYS[0]:
        _lines(figure, (left, right), support[token], context, weights[token])
    else:
        _lines(figure, (right, left), context[token], support, weights[token])
    image = matrix.imshow(weights, cmap="magma", vmin=0, aspect="auto")
    matrix.axhline(token, color=OWN, lw=1.2)
    bits = f"token {token}: entropy {entropy(weights[token]):.2f} of {np.log2(weights.shape[1]):.2f} bits"
    matrix.set_title(f"{way}\n{bits}", fontsize=9, color=INK)
    label_axes(matrix, "token that looks", "token that is seen")
    matrix.grid(False)
    figure.colorbar(image, ax=matrix, fraction=0.045, pad=0.02).ax.tick_params(labelsize=8)
    return figure


def entropy(weights: np.ndarray) -> np.ndarray:
    """Bits of distributions (..., n); log2 n where attention is spread evenly, 0 where it rests on one token."""
    return -(weights * np.log2(np.maximum(weights, 1e-12))).sum(-1)


def _crop(ax: Axes, clip: Clip, frame: int, places: np.ndarray, title: str, margin: float = 7) -> None:
    """A frame, cut to a square around places (n, 2)."""
    draw_image(ax, clip.video[frame], title)
    low, high = places.min(0), places.max(0)
    half = (high - low).max() / 2 + margin
    (u, v) = (low + high) / 2
    ax.set_xlim(u - half, u + half)
    ax.set_ylim(v + half, v - half)


def _lines(figure: Figure, axes: tuple[Axes, Axes], source: np.ndarray, target: np.ndarray, weight: np.ndarray) -> None:
    one, other = axes
    one.scatter(*source, s=60, color=OWN, edgecolors="white", zorder=5)
    other.scatter(*target.T, s=160 * weight / weight.max(), color=OWN, edgecolors="none", alpha=0.9, zorder=4)
    for place, w in zip(target, weight / weight.max(), strict=True):
        line = ConnectionPatch(
            source, place, "data", "data", axesA=one, axesB=other, color=OWN, lw=2 * w, alpha=0.8 * w
        )
        figure.add_artist(line)
