"""Metrics against the field's reference values, and against explicit loops."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.evaluation.evaluate import mean_scores, score_table
from tapip3d_lite.evaluation.metrics import MODES, SCALINGS

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "tests" / "data"
SHARED = ROOT.parent / "shared" / "golden"
THRESHOLDS = (1, 2, 4, 8, 16)  # pixels, in the benchmarks' definition


def camera_matrix(f):
    return np.array([[f[0], 0, f[2]], [0, f[1], f[3]], [0, 0, 1.0]])


def reference(folder, name):
    path = folder / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"{path.name}: reference vectors are not beside this checkout")
    return np.load(path)


def agrees(got, expected, where):
    for name, value in expected.items():
        value = np.nan if value is None else value
        np.testing.assert_allclose(got[name], value, rtol=0, atol=1e-9, err_msg=f"{where} {name}")


@pytest.mark.parametrize("folder", [OWN, SHARED], ids=["own", "shared"])
def test_tapvid3d_reference_values(folder):
    with reference(folder, "tapvid3d_metrics") as data:
        cases = json.loads(str(data["expected_json"]))
        for case in cases:
            i = case["case"]
            for scaling, expected in case["expected"].items():
                got = t3d.tapvid3d_metrics(
                    *(data[f"{i}/{k}"] for k in ("gt_xyz", "gt_visible", "xyz", "visible")),
                    camera_matrix(data[f"{i}/fx_fy_cx_cy"]),
                    data[f"{i}/query_frame"],
                    scaling,
                )
                agrees(got, expected, (i, scaling))
        assert {s for c in cases for s in c["expected"]} == set(SCALINGS)
        assert any(v is None or v != v for c in cases for e in c["expected"].values() for v in e.values())


@pytest.mark.parametrize("folder", [OWN, SHARED], ids=["own", "shared"])
def test_tapvid2d_reference_values(folder):
    with reference(folder, "tapvid2d_metrics") as data:
        cases = json.loads(str(data["expected_json"]))
        for case in cases:
            i = case["case"]
            for mode in MODES:
                arrays = (data[f"{i}/{k}"] for k in ("gt_uv", "gt_visible", "uv", "visible", "query_frame"))
                agrees(t3d.tapvid2d_metrics(*arrays, mode=mode), case["expected"][mode], (i, mode))


def random_case(rng):
    frames, count = rng.integers(1, 6), rng.integers(1, 5)
    p = rng.normal(size=(frames, count, 3)) + [0, 0, 4]
    q = p * rng.uniform(0.8, 1.2) + rng.normal(size=p.shape) * rng.choice([0.01, 0.1])
    v, w = rng.random((2, frames, count)) < 0.7
    return p, v, q, w, camera_matrix(rng.uniform(50, 200, 4))


def loop_3d(p, v, q, w, k, scale):
    correct = claimed = 0
    within = dict.fromkeys(THRESHOLDS, 0)
    both, wrong = dict.fromkeys(THRESHOLDS, 0), dict.fromkeys(THRESHOLDS, 0)
    for t in range(p.shape[0]):
        for n in range(p.shape[1]):
            correct += v[t, n] == w[t, n]
            claimed += w[t, n]
            for threshold in THRESHOLDS:
                radius = threshold * p[t, n, 2] / np.sqrt(k[0, 0] * k[1, 1])
                hit = sum((scale * q[t, n, i] - p[t, n, i]) ** 2 for i in range(3)) < radius**2
                within[threshold] += hit and v[t, n]
                both[threshold] += hit and v[t, n] and w[t, n]
                wrong[threshold] += w[t, n] and not (hit and v[t, n])
    visible = v.sum()
    with np.errstate(invalid="ignore", divide="ignore"):
        apd = np.mean([np.float64(within[x]) / visible for x in THRESHOLDS])
        aj = np.mean([np.float64(both[x]) / (visible + wrong[x]) for x in THRESHOLDS])
    return {"OA": correct / v.size, "APD3D": apd, "AJ3D": aj}


@pytest.mark.parametrize("seed", range(20))
def test_tapvid3d_is_the_loop(seed):
    p, v, q, w, k = random_case(np.random.default_rng(seed))
    agrees(t3d.tapvid3d_metrics(p, v, q, w, k, scaling="none"), loop_3d(p, v, q, w, k, 1.0), seed)
    both = v & w
    scale = (
        np.median(np.linalg.norm(p[both], axis=-1)) / np.median(np.linalg.norm(q[both], axis=-1))
        if both.any()
        else np.nan
    )
    agrees(t3d.tapvid3d_metrics(p, v, q, w, k), loop_3d(p, v, q, w, k, scale), seed)


def test_undefined_scores():
    p = np.full((2, 1, 3), 2.0)
    seen, hidden = np.ones((2, 1), bool), np.zeros((2, 1), bool)
    nothing = t3d.tapvid3d_metrics(p, hidden, p, hidden, np.eye(3))
    assert np.isnan(nothing["APD3D"]) and np.isnan(nothing["AJ3D"]) and nothing["OA"] == 1
    claimed = t3d.tapvid3d_metrics(p, hidden, p, seen, np.eye(3))
    assert np.isnan(claimed["APD3D"]) and claimed["AJ3D"] == 0
    missed = t3d.tapvid3d_metrics(p, seen, p, hidden, np.eye(3))
    assert missed["AJ3D"] == 0 and missed["APD3D"] == 0
    assert t3d.tapvid3d_metrics(p, seen, p, hidden, np.eye(3), scaling="none")["APD3D"] == 1


def test_bad_arguments_are_named():
    p, v, q, w, k = random_case(np.random.default_rng(0))
    for arguments, message in [
        ((p[..., :2], v, q, w, k), "truth: expected"),
        ((p, v, q[:-1], w, k), "prediction: expected"),
        ((p, v[:-1], q, w, k), "gt_visible"),
        ((p, v, q, w.astype(float), k), "visible"),
        ((p, v, q, w, k[:2]), "intrinsics"),
        ((p, v, q, w, np.repeat(k[None], len(p) + 1, 0)), r"intrinsics: expected \(\d, 3, 3\)"),
        ((p, v, q, w, 0 * k), "intrinsics: expected positive"),
        ((p, v, q, w, np.diag([0.0, 1, 1])), "intrinsics: expected positive"),
        ((p, v, q, w, k, [0] * 99), "queries"),
    ]:
        with pytest.raises(ValueError, match=message):
            t3d.tapvid3d_metrics(*arguments)
    with pytest.raises(ValueError, match="scaling: expected one of median"):
        t3d.tapvid3d_metrics(p, v, q, w, k, scaling="best")
    with pytest.raises(ValueError, match="needs the query frames"):
        t3d.tapvid3d_metrics(p, v, q, w, k, scaling="per_trajectory")
    with pytest.raises(ValueError, match="mode"):
        t3d.tapvid2d_metrics(p[..., :2], v, q[..., :2], w, np.zeros(p.shape[1]), mode="last")


@pytest.mark.parametrize("scaling", SCALINGS)
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_points_that_are_not_finite_are_misses(scaling, bad):
    p = np.random.default_rng(0).normal(size=(4, 3, 3)) + [0, 0, 4]
    seen, k, start = np.ones((4, 3), bool), camera_matrix([100, 100, 0, 0]), [0, 1, 2]
    scores = t3d.tapvid3d_metrics(p, seen, np.full_like(p, bad), seen, k, start, scaling)
    assert scores["AJ3D"] == scores["APD3D"] == 0
    q = p.copy()
    q[3, 0] = bad
    scores = t3d.tapvid3d_metrics(p, seen, q, seen, k, start, scaling)
    assert scores["APD3D"] <= 11 / 12
    if scaling in ("none", "per_trajectory", "reproduce_2d", "median_on_queries"):
        assert scores["APD3D"] == pytest.approx(11 / 12)


def test_an_error_of_exactly_the_threshold_is_a_miss():
    p, seen = np.zeros((1, 5, 3)) + [0, 0, 1], np.ones((1, 5), bool)
    q = p + np.array(THRESHOLDS)[:, None] * [1.0, 0, 0]  # with a focal length of 1 a pixel is 1 wide
    in_3d = t3d.tapvid3d_metrics(p, seen, q, seen, np.eye(3), scaling="none")
    extra = np.zeros((1, 5, 2))  # the 2D metrics leave out the query's frame
    truth, found = (np.concatenate([extra, x[..., :2]]) for x in (p, q))
    in_2d = t3d.tapvid2d_metrics(truth, np.ones((2, 5), bool), found, np.ones((2, 5), bool), np.zeros(5))
    for i, k in enumerate(THRESHOLDS):
        assert in_3d[f"within_{k}"] == in_2d[f"within_{k}"] == i / 5


@pytest.mark.parametrize("scaling", SCALINGS)
def test_points_at_the_camera_and_truth_without_numbers_raise_no_warning(scaling):
    p = np.random.default_rng(0).normal(size=(4, 3, 3)) + [0, 0, 4]
    seen, k, start = np.ones((4, 3), bool), camera_matrix([100, 100, 0, 0]), [0, 1, 2]
    for place in (slice(None), (3, 0)):
        q = p.copy()
        q[place] = 0
        assert t3d.tapvid3d_metrics(p, seen, q, seen, k, start, scaling)["APD3D"] <= 11 / 12
    p[:, 0], seen[:, 0] = np.inf, False  # a hidden point whose place nobody knows
    scores = t3d.tapvid3d_metrics(p, seen, np.abs(p), ~seen, k, start, scaling)
    assert scores["OA"] == 0
    t3d.tapvid2d_metrics(p[..., :2], seen, p[..., :2], seen, start)
    t3d.tapvid2d_metrics(p[..., :2], seen, np.full_like(p[..., :2], 1e200), seen, start)


def test_lists_and_whole_numbers_are_scored_as_floats():
    p, q = np.array([[[0, 0, 9]], [[20, 0, 9]]], np.uint8), np.array([[[1, 0, 9]], [[0, 0, 9]]], np.uint8)
    seen, k = np.ones((2, 1), bool), np.diag([9.0, 9.0, 1.0])
    expected = t3d.tapvid3d_metrics(p.astype(float), seen, q.astype(float), seen, k, scaling="none")
    assert expected["within_16"] == 0.5 and expected["within_1"] == 0  # 20 pixels, and not the 12 of uint8
    for form in (np.asarray, lambda x: x.tolist()):
        arguments = (form(x) for x in (p, seen, q, seen, k))
        assert t3d.tapvid3d_metrics(*arguments, scaling="none") == expected
    flat = t3d.tapvid2d_metrics(p[..., :2], seen, q[..., :2], seen, np.zeros(1))
    assert flat["within_16"] == 0  # the frame of 20 pixels


@pytest.mark.parametrize(
    "queries", [[4, 0], [-1, 0], [0.5, 0], [np.nan, 0], 0, [[[0], [0]]], ["a", "b"], np.zeros((2, 0)), None]
)
def test_query_frames_are_checked(queries):
    p, seen = np.ones((4, 2, 3)), np.ones((4, 2), bool)
    with pytest.raises(ValueError, match="queries"):
        t3d.tapvid3d_metrics(p, seen, p, seen, np.eye(3), queries, "per_trajectory")
    with pytest.raises(ValueError, match="queries"):
        t3d.tapvid2d_metrics(p[..., :2], seen, p[..., :2], seen, queries)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(10))
def test_tapvid2d_is_the_loop(mode, seed):
    rng = np.random.default_rng(seed)
    frames, count = rng.integers(1, 6), rng.integers(1, 5)
    p = rng.uniform(0, 256, (frames, count, 2))
    q = p + rng.normal(size=p.shape) * 4
    (v, w), start = rng.random((2, frames, count)) < 0.7, rng.integers(0, frames, count)
    within, jaccard = [], []
    for k in THRESHOLDS:
        hits = both = wrong = visible = correct = scored = 0
        for t in range(frames):
            for n in range(count):
                if t > start[n] if mode == "first" else t != start[n]:
                    hit = v[t, n] and np.hypot(*(q[t, n] - p[t, n])) < k
                    hits, both, wrong = hits + hit, both + (hit and w[t, n]), wrong + (w[t, n] and not hit)
                    visible, correct, scored = visible + v[t, n], correct + (v[t, n] == w[t, n]), scored + 1
        within.append(hits / visible if visible else np.nan)
        jaccard.append(both / (visible + wrong) if visible + wrong else np.nan)
    expected = {"OA": correct / scored if scored else np.nan, "APD2D": np.mean(within), "AJ2D": np.mean(jaccard)}
    agrees(t3d.tapvid2d_metrics(p, v, q, w, start, mode), expected, (seed, mode))


@pytest.fixture(scope="module")
def clip():
    return t3d.simulate_clip(seed=5, frames=8, size=(48, 64), tracks=60)


def test_evaluate_gives_the_truth_full_marks(clip):
    scores = t3d.evaluate(clip.tracks, clip)
    for name, value in scores.items():
        assert value == (0 if name.startswith("EPE") else 1), name
    assert {"AJ3D_dynamic", "AJ3D_static", "AJ3D_none", "AJ2D"} <= set(scores)


def test_evaluate_scales_intrinsics_to_256_pixels(clip):
    # An error of 1.5 pixels of the 256-pixel raster, sideways: inside 2 pixels, outside 1.
    camera = t3d.geometry.transform(clip.tracks.xyz, clip.extrinsics)
    focal = np.sqrt(clip.intrinsics[:, 0, 0] * clip.intrinsics[:, 1, 1])[:, None] * 256 / 48
    camera[..., 0] += 1.5 * camera[..., 2] / focal
    moved = t3d.geometry.transform(camera, t3d.geometry.invert(clip.extrinsics)).astype(np.float32)
    scores = t3d.evaluate(t3d.Tracks(moved, clip.tracks.visible, clip.queries), clip)
    assert scores["APD3D_none"] == pytest.approx(0.8)


def test_evaluate_knows_a_wrong_scale_from_wrong_tracks(clip):
    centre = t3d.geometry.invert(clip.extrinsics)[:, None, :3, 3]
    larger = centre + 1.3 * (clip.tracks.xyz - centre)
    scores = t3d.evaluate(t3d.Tracks(larger, clip.tracks.visible, clip.queries), clip)
    assert scores["APD3D"] > 0.999 > 0.2 > scores["APD3D_none"]


def test_evaluate_takes_some_of_the_tracks(clip):
    some = clip.tracks.select(clip.tracks.dynamic)
    scores = t3d.evaluate(some, replace(clip, queries=None, tracks=some))
    assert scores["AJ3D"] == scores["AJ3D_dynamic"] == 1 and np.isnan(scores["AJ3D_static"])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_evaluate_counts_what_is_not_finite_as_a_miss(clip, bad):
    xyz = clip.tracks.xyz.copy()
    xyz[np.where(clip.tracks.visible)[0][0], np.where(clip.tracks.visible)[1][0]] = bad
    scores = t3d.evaluate(t3d.Tracks(xyz, clip.tracks.visible, clip.queries), clip)
    assert scores["APD3D_none"] == pytest.approx(1 - 1 / clip.tracks.visible.sum())


def test_subsets_share_the_scale_of_the_whole_clip(clip):
    # Static points are 1.1 times too far, moving ones right: scales of their own would clear both.
    centre = t3d.geometry.invert(clip.extrinsics)[:, None, :3, 3]
    factor = np.where(clip.tracks.dynamic, 1, 1.1)[None, :, None].astype(np.float32)
    xyz = centre + factor * (clip.tracks.xyz - centre)
    scores = t3d.evaluate(t3d.Tracks(xyz, clip.tracks.visible, clip.queries), clip)
    assert min(scores["APD3D_dynamic"], scores["APD3D_static"]) < 0.9


def test_evaluate_refuses_other_queries(clip):
    with pytest.raises(ValueError, match="pred: expected 8 frames"):
        t3d.evaluate(clip.cut(0, 7).tracks, clip)
    with pytest.raises(ValueError, match="queries"):
        t3d.evaluate(clip.tracks.select(slice(3)), clip)
    with pytest.raises(ValueError, match="no true tracks"):
        t3d.evaluate(clip.tracks, t3d.Clip(clip.video, clip.depths, clip.intrinsics, clip.extrinsics))


def test_means_and_tables():
    mean = mean_scores([{"a": 1.0, "b": np.nan}, {"a": 0.0, "b": 0.5}, {"a": 0.5}])
    assert mean == {"a": 0.5, "b": 0.5}
    assert score_table({"x": mean}, ("a", "b")).splitlines()[-1] == "| x | 0.500 | 0.500 |"
