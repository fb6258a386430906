"""Figures of notebook 04, by their state."""

import numpy as np
import pytest
import torch
from matplotlib.patches import ConnectionPatch

import tapip3d_lite as t3d
from lessons.n04 import (
    WAYS,
    AttentionPair,
    cell_centers,
    clear_and_fast,
    cloud_of,
    coin,
    cost_curves,
    entropy,
    floors,
    fourier_waves,
    hits,
    last_updates,
    metres_per_unit,
    paint,
    paired_bags,
    partner_attention,
    rates,
    tiles,
    two_bags,
    who_looks_where,
)
from tapip3d_lite.geometry import project

K = 4


def record(clip, queries, context="n2n"):
    torch.manual_seed(0)
    sizes = {"image_size": (32, 32), "window": 4, "levels": 2, "neighbors": K, "iterations": 2, "hidden": 32}
    tracker = t3d.Tracker(t3d.TrackerConfig.preset("lite", context=context, **sizes)).eval()
    with t3d.Recorder(tracker, columns=range(len(queries))) as recorder:
        tracker.track(clip, queries, support_grid=0, bidirectional=False)
    return recorder.steps, tracker.config.grid_sizes


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=4, frames=6, size=(32, 32), tracks=40)


@pytest.fixture(scope="module")
def queries(clip):
    seen = np.flatnonzero(clip.tracks.visible[0])[:5]
    rows = np.concatenate([np.zeros((5, 1)), clip.tracks.xyz[0, seen]], -1).astype(np.float32)
    rows[4, 0] = 4  # asked for late: the first window does not contain it
    return rows


@pytest.fixture(scope="module")
def pair(clip, queries):
    steps, grids = record(clip, queries)
    return AttentionPair.of(clip, steps, queries, grids, track=2, frame=5, level=0)


def test_cells_stand_on_the_pixels_that_gave_them_their_points():
    np.testing.assert_array_equal(
        cell_centers(np.array([0, 1, 8, 63]), (8, 8), (32, 32)), [[2, 2], [6, 2], [2, 6], [30, 30]]
    )
    np.testing.assert_array_equal(cell_centers(np.array([5]), (2, 4), (32, 48)), [[18, 24]])  # wide images


def test_a_pair_is_of_the_last_update_and_of_its_track(clip, queries, pair):
    step = record(clip, queries)[0][-1]
    assert pair.frames == (0, 5) and pair.row == 5 - step.start
    assert torch.equal(pair.record.near.points, step.levels[0].near.points)
    uv, _ = project(queries[2:3, 1:], clip.intrinsics[0], clip.extrinsics[0])
    support, context = pair.places
    np.testing.assert_allclose(support[0], uv[0])
    assert support.shape == (K + 1, 2) and context.shape == (K, 2)
    u, v = context.astype(int).T
    camera = t3d.geometry.unproject(context.astype(np.float32), clip.depths[5, v, u], clip.intrinsics[5])
    drawn, known = camera, pair.record.near.points[pair.row, pair.column].numpy()  # alike up to a similarity
    drawn, known = (np.linalg.norm(x[1:] - x[0], axis=-1) for x in (drawn, known))
    np.testing.assert_allclose(drawn / drawn.sum(), known / known.sum(), atol=1e-3)


def test_a_pair_that_was_not_recorded_is_refused(clip, queries):
    steps, grids = record(clip, queries)
    with pytest.raises(ValueError, match="track 4"):
        AttentionPair.of(clip, steps, queries, grids, track=4, frame=0)
    assert AttentionPair.of(clip, steps, queries, grids, track=4, frame=5).column == steps[-1].columns.index(4)
    with pytest.raises(ValueError, match="frame"):
        AttentionPair.of(clip, steps, queries, grids, frame=99)


def test_two_bags_draw_all_tokens(pair):
    figure = two_bags(pair)
    left, middle, offsets = figure.axes
    np.testing.assert_allclose(left.collections[0].get_offsets(), pair.places[0])
    np.testing.assert_allclose(middle.collections[0].get_offsets(), pair.places[1])
    bags = [np.asarray(c.get_offsets()) for c in offsets.collections]
    np.testing.assert_allclose(bags[1], pair.record.near.offsets[pair.row, pair.column][:, [0, 2]], atol=1e-6)
    assert [len(b) for b in bags] == [K, K, 1]
    assert "frame 0" in left.get_title() and "frame 5" in middle.get_title()


@pytest.mark.parametrize("way", WAYS)
def test_lines_are_as_strong_as_the_attention(pair, way):
    figure = who_looks_where(pair, token=1, way=way)
    weights = pair.weights(way)
    assert weights.shape == ((K + 1, K) if way == WAYS[0] else (K, K + 1))
    np.testing.assert_allclose(weights.sum(-1), 1, rtol=1e-5)
    lines = [a for a in figure.artists if isinstance(a, ConnectionPatch)]
    widths = np.array([line.get_linewidth() for line in lines])
    np.testing.assert_allclose(widths, 2 * weights[1] / weights[1].max(), rtol=1e-5)
    support, context = pair.places
    here, there = (support, context) if way == WAYS[0] else (context, support)
    np.testing.assert_allclose(lines[0].xy1, here[1])
    np.testing.assert_allclose([line.xy2 for line in lines], there)
    np.testing.assert_allclose(figure.axes[2].images[0].get_array(), weights)
    assert f"{entropy(weights[1]):.2f} of" in figure.axes[2].get_title()


def test_what_cannot_be_drawn_is_refused_in_words(clip, queries, pair):
    with pytest.raises(ValueError, match="token: expected 0 to 4"):
        who_looks_where(pair, token=K + 1)
    with pytest.raises(ValueError, match="way: expected one of"):
        who_looks_where(pair, way="sideways")
    steps, grids = record(clip, queries, context="p2n")
    with pytest.raises(ValueError, match="context='n2n'"):
        who_looks_where(AttentionPair.of(clip, steps, queries, grids, frame=5))


def test_entropy():
    np.testing.assert_allclose(entropy(np.array([[0.25] * 4, [1, 0, 0, 0]])), [2, 0], atol=1e-6)


def test_waves_are_the_librarys_and_fade_where_a_pixel_is_too_coarse():
    figure = fourier_waves(reach=1.0, samples=100)
    rows = np.asarray(figure.axes[0].images[0].get_array())
    assert rows.shape == (16, 100)
    np.testing.assert_allclose(rows[2], np.sin(np.linspace(0, 1, 6400)).reshape(100, 64).mean(1), atol=1e-6)
    assert np.abs(rows[-1]).max() < 0.3 < np.abs(rows[4]).max()
    slow, middle, fast = (line.get_ydata() for line in figure.axes[1].lines)
    alike = [(y > 0.5).sum() for y in (slow, middle, fast)]
    assert alike[0] > alike[1] > alike[2]


def test_rates_draw_means_and_intervals():
    y = np.array([[0.2, 0.4], [0.4, 0.8], [0.3, 0.6]])
    figure = rates(
        {"a": {"one": ([4, 8], y), "chance": ([4, 8], [[0.25, 0.125]])}, "b": {"one": ([4, 8], y)}}, "K", "share"
    )
    first = figure.axes[0].containers[0]
    np.testing.assert_allclose(first.lines[0].get_ydata(), [0.3, 0.6])
    low, high = (c.get_ydata() for c in first.lines[1])
    np.testing.assert_allclose(high - low, 2 * 1.96 * y.std(0, ddof=1) / 3**0.5)
    assert [ax.get_title() for ax in figure.axes] == ["a", "b"] and not figure.axes[0].containers[1].lines[1]


def test_curves_differ_by_more_than_their_colour():
    y = np.array([[0.2, 0.4], [0.4, 0.8]])
    drawn = rates({"a": {name: ([4, 8], y) for name in "pqrst"}}, "K", "share").axes[0].containers
    assert len({container.lines[0].get_marker() for container in drawn}) == 5


def test_costs_are_drawn_with_a_legend_of_colours_and_one_of_line_styles():
    cost = {d: clear_and_fast([2, 4], d, rounds=1) for d in (8, 16)}
    assert all(time > 0 and count > 0 for table in cost.values() for time, count in table.values())
    assert cost[8][4, "clear"][1] > cost[8][4, "fast"][1] > cost[8][2, "fast"][1]
    figure = cost_curves(cost)
    arithmetic, clock = figure.axes
    np.testing.assert_allclose(arithmetic.lines[1].get_ydata(), [cost[8][k, "fast"][1] / 1e6 for k in (2, 4)])
    np.testing.assert_allclose(clock.lines[2].get_ydata(), [cost[16][k, "clear"][0] for k in (2, 4)])
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words == ["D = 8", "D = 16", "clear form", "fast form"]
    solid, dashed = figure.legends[0].get_lines()[2:]
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")


def test_floors_show_the_paint_of_each_cell(clip):
    level = cloud_of(clip)
    figure = floors(level, {"own": lambda p: p, "coin": coin}, frame=2)
    own, tiled = (np.asarray(ax.images[0].get_array()) for ax in figure.axes)
    assert own.shape == (*level.points.shape[2:4], 3) and own.std() > 0.1
    known = level.valid[0, 2].numpy()
    np.testing.assert_array_equal(tiled[known][:, 0], coin(level.points[0, 2]).numpy()[known][:, 0])
    same = (tiles(level.points[0, 2])[:, 1:] == tiles(level.points[0, 2])[:, :-1]).all(-1).numpy()
    assert (tiled[:, 1:, 0] == tiled[:, :-1, 0])[same & known[:, 1:] & known[:, :-1]].all()


def test_a_point_with_its_own_colour_is_found_and_one_without_features_is_not(clip):
    level = cloud_of(clip)
    shares = {}
    for name, colors in {"own": level.points, "grey": torch.zeros_like(level.points)}.items():
        rng = np.random.default_rng(0)
        shares[name] = hits(paired_bags(clip, paint(level, colors), 8, rng, moving=False), rng)
    assert shares["own"]["P2N"] > 0.7 > 0.5 > shares["grey"]["P2N"]
    assert shares["own"]["shape alone"] == shares["grey"]["shape alone"]


def test_partners_are_found_around_the_true_point(clip, queries):
    steps, _ = record(clip, queries[:4])
    ends = last_updates(steps)
    assert [step.start for step in ends] == sorted({step.start for step in steps})
    assert all(metres_per_unit(step) == pytest.approx(metres_per_unit(ends[0]), rel=0.5) for step in ends)
    seen = np.flatnonzero(clip.tracks.visible[0])[:4]
    trained, alike = partner_attention(steps, clip, seen)
    assert trained.shape == alike.shape == (4,)
    assert ((trained[np.isfinite(trained)] >= 0) & (trained[np.isfinite(trained)] <= K)).all()
    # Attention that rests on the partner alone gives K times chance; spread evenly, chance.
    for step in ends:
        step.levels[0].support_from_context.fill_(1 / K)
    even, _ = partner_attention(steps, clip, seen)
    np.testing.assert_allclose(even[np.isfinite(even)], 1, rtol=1e-5)
