"""Lesson 09: on whose object lie the cells that a neighbourhood picks, before anything is trained; and a look at them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure

from lessons.n03_cells import track_objects
from tapip3d_lite.clip import Clip
from tapip3d_lite.figures.flat import INK, draw_image, label_axes
from tapip3d_lite.geometry import project
from tapip3d_lite.model.cloud import nearest_exact
from tapip3d_lite.model.frames import frames_from_clip
from tapip3d_lite.model.neighbors import bilinear, knn
from tapip3d_lite.model.tracker import Tracker

LOOKS = {"nearest": ("#0072b2", "o"), "alike": ("#d55e00", "s"), "by lot": ("#8a919c", "x")}  # of Okabe and Ito


@dataclass(frozen=True)
class Picked:
    """Cells of one frame that three rules pick around the true places of moving points.

    Attributes:
        clip, frame: where.
        uv: (N, 2) pixels of the points.
        pixels: by rule (N, K, 2), pixels of the cells.
        right: by rule (N, K), whether a cell lies on the point's own object.
        away: by rule (N, K), metres from the point.
    """

    clip: Clip
    frame: int
    uv: np.ndarray
    pixels: Mapping[str, np.ndarray]
    right: Mapping[str, np.ndarray]
    away: Mapping[str, np.ndarray]


@torch.no_grad()
def picked(
    clip: Clip, objects: np.ndarray, frame: int, alike: Callable, tracker: Tracker, count: int, level: int = 0
) -> Picked:
    """Pick `count` cells of a level of a frame around every moving point that it shows: nearest, most alike, by lot.

    Args:
        clip: with true tracks, of the tracker's image size.
        objects: (T, H, W), from `simulate.object_maps`.
        frame: which one.
        alike: an answer to `09.alike`.
        tracker: whose encoder makes the features.
        count: K.
        level: of the cloud.
    """
    frames = frames_from_clip(clip.cut(frame, frame + 1))
    scene = tracker.scene(frames, tracker.encoder(frames.rgb), tracker.resolve_space(None), None)
    cloud = scene.levels[level].cut(0, 1)
    chosen = np.flatnonzero(clip.tracks.dynamic & clip.tracks.visible[frame])
    xyz = clip.tracks.xyz[frame, chosen]
    uv, _ = project(xyz, clip.intrinsics[frame], clip.extrinsics[frame])
    maps, points, valid = (x.flatten(0, 1) for x in (cloud.features, cloud.points, cloud.valid))
    own = bilinear(maps, cloud.cells(torch.from_numpy(uv).float()[None, None], clip.size)[0])
    flat = points.flatten(1, 2), valid.flatten(1)
    lot = torch.rand(1, len(chosen), flat[1].shape[1], generator=torch.Generator().manual_seed(0))
    found = {
        "nearest": knn(torch.from_numpy(xyz).float()[None], flat[0], count, flat[1]),
        "alike": alike(own, maps.flatten(1, 2), flat[1], count),
        "by lot": lot.masked_fill(~flat[1][:, None], -1).topk(count, -1).indices,
    }
    rows, columns = (
        nearest_exact(n, m, torch.device("cpu")).numpy() for n, m in zip(clip.size, maps.shape[1:3], strict=True)
    )
    whose = objects[frame][np.ix_(rows, columns)].ravel()
    places = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    cells = flat[0][0].numpy()
    index = {name: one[0].numpy() for name, one in found.items()}
    mine = track_objects(clip, objects)[chosen]
    return Picked(
        clip,
        frame,
        uv,
        {name: places[one] for name, one in index.items()},
        {name: whose[one] == mine[:, None] for name, one in index.items()},
        {name: np.linalg.norm(cells[one] - xyz[:, None], axis=-1) for name, one in index.items()},
    )


def cells_figure(cells: Picked, points: list[int]) -> Figure:
    """The cells of some points in the image: a panel a point, nearest ones as dots, most alike ones as squares."""
    figure = Figure(figsize=(3.4 * len(points), 3.8), layout="constrained")
    for ax, n in zip(figure.subplots(1, len(points), squeeze=False)[0], points, strict=True):
        draw_image(ax, cells.clip.video[cells.frame], "")
        for name in ("nearest", "alike"):
            color, marker = LOOKS[name]
            ax.plot(*cells.pixels[name][n].T, marker, color=color, ms=6, mec="white", mew=0.8, label=name)
        ax.plot(*cells.uv[n], "*", color="#f0e442", ms=12, mec=INK, mew=0.8, label="the point")
    figure.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def shares_figure(shares: Mapping[str, float], away: Mapping[str, np.ndarray]) -> Figure:
    """By rule: the share of cells on the point's own object, and how far they are."""
    figure = Figure(figsize=(8.2, 2.7), layout="constrained")
    left, right = figure.subplots(1, 2)
    names, colors = list(shares), [LOOKS[name][0] for name in shares]
    left.bar_label(left.barh(names, list(shares.values()), color=colors), fmt="{:.0%}", fontsize=9)
    left.set_xlim(0, 1.15)
    label_axes(left, "", "share on the point's own object")
    right.bar_label(right.barh(names, [np.median(away[name]) for name in names], color=colors), fmt="%.2f", fontsize=9)
    label_axes(right, "", "median distance to the point (m)")
    for ax in (left, right):
        ax.invert_yaxis()
        ax.tick_params(labelsize=9)
    return figure
