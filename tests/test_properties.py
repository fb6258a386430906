"""What holds for every input: hypothesis looks for one for which it does not, and makes it small."""

import io
import pickle
from contextlib import suppress
from itertools import pairwise

import numpy as np
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.metrics import SCALINGS, THRESHOLDS
from tapip3d_lite.files import load_npz, load_objects, save_npz
from tapip3d_lite.geometry import invert, look_at, project, resize_intrinsics, transform, unproject
from tapip3d_lite.model.neighbors import knn
from tapip3d_lite.model.windows import window_ends
from tapip3d_lite.pickled import Machine
from tapip3d_lite.queries import grid_queries, near_origin

# The same examples in every run: a failure is one of the change that is tested.
settings.register_profile(
    "tests",
    derandomize=True,
    deadline=None,
    max_examples=60,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("tests")


def numbers(low, high):
    return st.floats(low, high, allow_subnormal=False)


def rows(width, low, high, most=8):
    shapes = st.integers(1, most).map(lambda n: (n, width))
    return shapes.flatmap(lambda shape: hnp.arrays(np.float64, shape, elements=numbers(low, high)))


@st.composite
def cameras(draw):
    """Intrinsics (3, 3) and extrinsics (4, 4) of a camera that looks at the origin from somewhere."""
    fx, fy, cx, cy = (draw(numbers(*limits)) for limits in ((20, 2000), (20, 2000), (-50, 1000), (-50, 1000)))
    eye = np.array([draw(numbers(-20, 20)) for _ in range(3)])
    assume(np.linalg.norm(eye[[0, 2]]) > 0.5)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), look_at(eye, np.zeros(3), np.array([0, -1.0, 0]))


@given(cameras(), rows(3, 0.0, 1.0))
def test_a_pixel_with_depth_comes_back(camera, values):
    intrinsics, extrinsics = camera
    uv, z = values[:, :2] * 1000, 0.1 + values[:, 2] * 100
    back, depth = project(unproject(uv, z, intrinsics, extrinsics), intrinsics, extrinsics)
    assert np.allclose(back, uv, atol=1e-6) and np.allclose(depth, z, rtol=1e-9)


@given(cameras(), rows(3, -1e3, 1e3))
def test_an_inverted_pose_leads_back_and_keeps_distances(camera, points):
    pose = camera[1]
    moved = transform(points, pose)
    assert np.allclose(transform(moved, invert(pose)), points, atol=1e-9)
    assert np.allclose(np.linalg.norm(moved[0] - moved, axis=-1), np.linalg.norm(points[0] - points, axis=-1))


@given(cameras(), st.tuples(*[st.integers(2, 3000)] * 4), st.booleans())
def test_resizing_there_and_back_changes_no_camera(camera, sides, corners):
    old, new = sides[:2], sides[2:]
    there = resize_intrinsics(camera[0], old, new, corners=corners)
    assert np.allclose(resize_intrinsics(there, new, old, corners=corners), camera[0], rtol=1e-9)
    # The image's own corner stays its corner: the outer one, or the pixel's centre.
    edge = np.array([0.0, 0.0]) if corners else np.array([-0.5, -0.5])
    far = np.array(old[::-1]) - 1 - edge
    point = unproject(np.stack([edge, far]), np.ones(2), camera[0])
    assert np.allclose(project(point, there)[0], np.stack([edge, np.array(new[::-1]) - 1 - edge]), atol=1e-6)


@st.composite
def tracked(draw):
    """Truth, prediction and intrinsics of a few points, with numbers that are not finite among the predictions."""
    frames, count = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    shape = (frames, count)
    p = draw(hnp.arrays(np.float64, (*shape, 3), elements=numbers(-3, 3))) + [0, 0, 6]
    wrong = draw(hnp.arrays(np.float64, (*shape, 3), elements=numbers(-0.2, 0.2) | st.sampled_from([np.nan, np.inf])))
    v, w = (draw(hnp.arrays(np.bool_, shape)) for _ in range(2))
    queries = draw(hnp.arrays(np.int64, count, elements=st.integers(0, frames - 1)))
    k = np.broadcast_to(np.diag([draw(numbers(50, 500))] * 2 + [1.0]), (frames, 3, 3))
    return p, v, p + wrong, w, k, queries


def score(case, scaling, **changed):
    p, v, q, w, k, queries = (changed.get(name, value) for name, value in zip("pvqwkt", case, strict=True))
    with np.errstate(all="ignore"):
        return t3d.tapvid3d_metrics(p, v, q, w, k, queries=queries, scaling=scaling)


def same(one, other):
    assert one.keys() == other.keys()
    assert all(np.isclose(one[k], other[k], atol=1e-12, equal_nan=True) for k in one), (one, other)


@given(tracked(), st.sampled_from(SCALINGS), st.randoms(use_true_random=False))
def test_scores_are_fractions_that_ask_for_no_order_of_tracks(case, scaling, random):
    scores = score(case, scaling)
    assert all(np.isnan(value) or 0 <= value <= 1 for value in scores.values())
    within = [scores[f"within_{k}"] for k in THRESHOLDS]
    assert np.isnan(within).all() or within == sorted(within)  # a wider threshold forgives more
    assert np.isnan(scores["APD3D"]) or scores["AJ3D"] <= scores["APD3D"] + 1e-12
    order = random.sample(range(len(case[5])), len(case[5]))
    mixed = {name: value[:, order] for name, value in zip("pvqw", case, strict=False)}
    same(score(case, scaling, **mixed, t=case[5][order]), scores)


@given(tracked(), st.sampled_from([x for x in SCALINGS if x != "none"]), st.integers(-6, 6))
def test_no_scale_counts_where_the_scores_take_it_out(case, scaling, power):
    # By powers of two, which round nothing: a point at a threshold stays on its side.
    same(score(case, scaling, q=case[2] * 2.0**power), score(case, scaling))


@given(tracked())
def test_the_truth_has_full_marks(case):
    p, v, *_ = case
    scores = score(case, "none", q=p, w=v)
    assert scores["OA"] == 1 and (not v.any() or scores["AJ3D"] == scores["APD3D"] == 1)


@given(
    hnp.arrays(np.int8, st.tuples(st.just(1), st.integers(1, 4), st.just(3)), elements=st.integers(-3, 3)),
    hnp.arrays(np.int8, st.tuples(st.just(1), st.integers(1, 20), st.just(3)), elements=st.integers(-3, 3)),
    st.data(),
)
def test_neighbours_are_those_of_a_stable_sort_with_all_its_ties(queries, points, data):
    count = data.draw(st.integers(1, points.shape[1]))
    near = knn(torch.tensor(queries), torch.tensor(points), count)[0].numpy()
    squared = ((queries[0, :, None].astype(int) - points[0].astype(int)) ** 2).sum(-1)
    assert (near == np.argsort(squared, axis=1, kind="stable")[:, :count]).all()


@given(st.integers(1, 200), st.integers(1, 20).map(lambda half: 2 * half))
def test_windows_cover_every_frame_by_half_steps(frames, window):
    ends = [*window_ends(frames, window)]
    assert all(b - a == window // 2 for a, b in pairwise(ends))
    padded = frames + -frames % (window // 2)
    covered = {t for end in window_ends(max(padded, window), window) for t in range(end - window, end)}
    assert covered == set(range(max(padded, window)))


@given(st.integers(1, 40), st.integers(1, 300), st.integers(1, 9))
def test_grids_lie_inside_every_image(height, width, side):
    clip = t3d.Clip(
        video=np.zeros((2, height, width, 3), np.uint8),
        depths=np.ones((2, height, width), np.float32),
        intrinsics=np.broadcast_to(np.diag([50.0, 50, 1]), (2, 3, 3)),
        extrinsics=np.broadcast_to(np.eye(4), (2, 4, 4)),
    )
    queries = grid_queries(clip, side)
    uv = project(queries[:, 1:], clip.intrinsics[0])[0]
    assert len(queries) and (uv > -0.501).all() and (uv < [width - 0.499, height - 0.499]).all()


PLAIN = hnp.scalar_dtypes().filter(lambda d: d.kind in "biuf" and d.itemsize <= 8) | hnp.unicode_string_dtypes(
    max_len=4
)
NAMES = st.text("abcdefgh_0123", min_size=1, max_size=6)


@given(st.dictionaries(NAMES, hnp.arrays(PLAIN, hnp.array_shapes(min_dims=0, min_side=0)), max_size=3))
def test_arrays_come_back_from_our_npz_and_from_numpys(tmp_path, arrays):
    save_npz(tmp_path / "ours.npz", arrays)
    np.savez(tmp_path / "numpys.npz", **arrays)
    for name in ("ours", "numpys"):
        found = load_npz(tmp_path / f"{name}.npz")
        assert found.keys() == arrays.keys()
        for key, value in arrays.items():
            assert found[key].dtype == value.dtype and found[key].shape == value.shape
            assert found[key].tobytes() == value.tobytes()


LEAVES = (
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=8) | st.binary(max_size=8)
)
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4) | st.tuples(inner)
    ),
    max_leaves=12,
)


@given(VALUES, st.sampled_from([2, 3, 4, 5]))
def test_what_pickle_writes_of_plain_values_is_read_without_it(value, protocol):
    found = Machine().run(pickle.dumps(value, protocol=protocol))
    assert repr(found) == repr(value)  # NaN differs from itself


@given(VALUES, st.data())
def test_a_changed_pickle_is_read_or_refused(value, data):
    content = bytearray(_npy(value))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    with suppress(ValueError):  # no other error, and nothing is run
        load_objects("x", io.BytesIO(bytes(content)))


def _npy(value):
    buffer, array = io.BytesIO(), np.empty((), object)
    array[()] = value
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


@given(numbers(-1e8, 1e8), st.sampled_from(["x", "y", "z"]))
def test_a_clip_far_away_is_near_once_it_is_moved(offset, axis):
    shift = np.zeros(3)
    shift["xyz".index(axis)] = offset
    extrinsics = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
    extrinsics[:, :3, 3] = -shift
    clip = t3d.Clip(
        video=np.zeros((2, 4, 6, 3), np.uint8),
        depths=np.ones((2, 4, 6), np.float32),
        intrinsics=np.broadcast_to(np.diag([5.0, 5, 1]), (2, 3, 3)),
        extrinsics=extrinsics,
    )
    near, moved = near_origin(clip)
    points = grid_queries(near, 2)
    assert np.abs(points[:, 1:]).max() < 200
    assert np.allclose(
        points[:, 1:].astype(np.float64) + moved, grid_queries(clip, 2)[:, 1:], atol=1e-6 + abs(offset) * 1e-6
    )
