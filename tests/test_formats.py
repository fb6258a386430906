"""Foreign clips: each format written from a known clip in its own layout, read back, compared with the truth."""

import io
import json
import pickle
import sys
import zipfile
from dataclasses import replace

import cv2
import numpy as np
import pytest

import tapip3d_lite as t3d
from tapip3d_lite.depth import register_depth
from tapip3d_lite.files import load_objects
from tapip3d_lite.formats import FORMATS
from tapip3d_lite.formats.images import read_depth
from tapip3d_lite.geometry import invert, point_map, project, resize_intrinsics, transform

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
FRAMES = 5
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]


@pytest.fixture(scope="module")
def clip():
    clip = t3d.simulate_clip(seed=4, frames=FRAMES, size=(48, 64), camera="handheld", handheld=4.0, tracks=16)
    assert np.ptp(clip.extrinsics, axis=0).max() > 0.02
    depths = clip.depths.copy()
    depths[:, 5:8, 9:13] = 0
    return replace(clip, depths=depths)


def quaternion(rotation):
    """x, y, z, w of a rotation: the eigenvector of Bar-Itzhack's matrix, which no angle makes inexact."""
    r = rotation
    m = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    q = np.linalg.eigh(m, UPLO="L")[1][:, -1]
    return q * np.sign(q[3])


def poses(clip, opengl=False):
    """Camera to world, float64."""
    extrinsics = clip.extrinsics.astype(np.float64)
    return np.linalg.inv(FLIP @ extrinsics if opengl else extrinsics)


def put(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def whole(depth, scale):
    """16 bits of depth; what is too far for them is unknown, as in sensors."""
    depth = np.rint(depth.astype(np.float64) * scale)
    return np.where(depth < 65535, depth, 0).astype(np.uint16)


def fx_fy_cx_cy(clip):
    return clip.intrinsics[0][[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float64)


def text(path, rows):
    path.write_text("\n".join(" ".join(map(repr, map(float, np.ravel(row)))) for row in rows) + "\n")


# --- writers: each returns what to load ------------------------------------------------------------------------------


def write_npz(clip, folder):
    clip.save(folder / "clip.npz")
    return folder / "clip.npz"


def write_result(clip, folder):
    clip.tracks.save(folder / "clip.npz", clip)
    return folder / "clip.npz"


def write_tapvid3d(clip, folder, **changes):
    jpegs = [cv2.imencode(".jpg", x[..., ::-1], QUALITY)[1].tobytes() for x in clip.video]
    images = np.empty(len(jpegs), object)
    images[:] = jpegs
    t = clip.queries[:, 0].astype(int)
    uv = project(clip.queries[:, None, 1:], clip.intrinsics[t], clip.extrinsics[t])[0][:, 0]
    arrays = {
        "images_jpeg_bytes": images,
        "tracks_XYZ": transform(clip.tracks.xyz, clip.extrinsics),
        "visibility": clip.tracks.visible,
        "queries_xyt": np.concatenate([uv, t[:, None]], 1),
        "fx_fy_cx_cy": fx_fy_cx_cy(clip),
        "extrinsics_w2c": clip.extrinsics,
    }
    np.savez(folder / "clip.npz", **(arrays | changes))
    return folder / "clip.npz"


def write_megasam(clip, folder):
    arrays = {"images": clip.video, "depths": clip.depths.astype(np.float16), "intrinsic": clip.intrinsics[0]}
    np.savez(folder / "clip.npz", **arrays, cam_c2w=poses(clip).astype(np.float32))
    return folder / "clip.npz"


def write_vggt(clip, folder):
    images = np.moveaxis(clip.video, -1, 1).astype(np.float32) / 255
    cameras = {"intrinsic": clip.intrinsics, "extrinsic": clip.extrinsics[:, :3]}
    np.savez(folder / "clip.npz", images=images, depth=clip.depths[..., None], **cameras, depth_conf=clip.depths)
    return folder / "clip.npz"


def write_depth_anything(clip, folder):
    cameras = {"intrinsics": clip.intrinsics, "extrinsics": clip.extrinsics[:, :3]}
    np.savez(folder / "clip.npz", image=clip.video, depth=clip.depths, **cameras, conf=clip.depths)
    return folder / "clip.npz"


def write_tum(clip, folder):
    """Colour at 0, 1/30, ... s, depth 6 ms later, poses at the colour's times with changing signs."""
    lists = {"rgb": ["# colour"], "depth": ["# depth"], "groundtruth": ["# timestamp tx ty tz qx qy qz qw"]}
    for i, (image, depth, pose) in enumerate(zip(clip.video, clip.depths, poses(clip), strict=True)):
        time = 1305031102.5 + i / 30
        put(folder / "rgb" / f"{time:.6f}.png", image)
        put(folder / "depth" / f"{time + 0.006:.6f}.png", whole(depth, 5000))
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{time + 0.006:.6f} depth/{time + 0.006:.6f}.png")
        numbers = [*pose[:3, 3], *(quaternion(pose[:3, :3]) * (-1) ** (i // 2))]
        lists["groundtruth"].append(f"{time:.6f} " + " ".join(repr(float(x)) for x in numbers))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    text(folder / "intrinsics.txt", [fx_fy_cx_cy(clip)])
    return folder


def write_7scenes(clip, folder):
    for i, (image, depth, pose) in enumerate(zip(clip.video, clip.depths, poses(clip), strict=True)):
        put(folder / f"frame-{i:06d}.color.png", image)
        depth = whole(depth, 1000)
        put(folder / f"frame-{i:06d}.depth.png", np.where(depth == 0, 65535, depth).astype(np.uint16))
        text(folder / f"frame-{i:06d}.pose.txt", pose)
    k = fx_fy_cx_cy(clip).tolist()  # one camera: registration must change nothing
    (folder / "clip.json").write_text(
        json.dumps({"intrinsics": k, "depth_intrinsics": k, "color_from_depth": np.eye(4).tolist()})
    )
    return folder


def write_record3d(clip, folder, exr=True):
    k = clip.intrinsics[0].astype(np.float64)
    rows = [[*quaternion(p[:3, :3]), *p[:3, 3]] for p in poses(clip, opengl=True)]
    meta = {
        "w": 64,
        "h": 48,
        "dw": 64,
        "dh": 48,
        "fps": 60,
        "K": k.T.ravel().tolist(),
        "poses": np.array(rows).tolist(),
    }
    (folder / ("metadata.json" if exr else "metadata")).write_text(json.dumps(meta))
    for i, (image, depth) in enumerate(zip(clip.video, clip.depths, strict=True)):
        if exr:
            put(folder / "rgb" / f"{i}.png", image)
            (folder / "depth").mkdir(exist_ok=True)
            write_exr(folder / "depth" / f"{i}.exr", R=depth)
        else:
            put(folder / "rgbd" / f"{i}.jpg", image)
            (folder / "rgbd" / f"{i}.depth").write_bytes(depth.tobytes())
    return folder


def normalised(clip):
    k = clip.intrinsics.astype(np.float64)
    k[:, :2, 2] += 0.5
    k[:, 0] /= 64
    k[:, 1] /= 48
    return k @ np.diag([1, -1, -1])  # with the signs that Kubric writes


def rays(clip):
    return clip.depths * np.linalg.norm(point_map(np.ones_like(clip.depths), clip.intrinsics), axis=-1)


def write_movi(clip, folder):
    for i, (image, ray) in enumerate(zip(clip.video, rays(clip), strict=True)):
        alpha = np.full((*image.shape[:2], 1), 255, np.uint8)
        put(folder / f"rgba_{i:05d}.png", np.concatenate([alpha, image], -1))  # `put` reverses: B G R A
        put(folder / f"depth_{i:05d}.tiff", ray.astype(np.float32))
        put(folder / f"normal_{i:05d}.png", image)
    c2w = poses(clip, opengl=True)
    camera = {"K": normalised(clip)[0].tolist(), "positions": c2w[:, :3, 3].tolist()}
    camera["quaternions"] = [quaternion(p[:3, :3])[[3, 0, 1, 2]].tolist() for p in c2w]
    (folder / "metadata.json").write_text(json.dumps({"camera": camera}))
    return folder


def write_kubric(clip, folder):
    low, high = float(rays(clip).min()), float(rays(clip).max())
    for i, (image, ray) in enumerate(zip(clip.video, rays(clip), strict=True)):
        put(folder / "frames" / f"{i:03d}.png", image)
        put(folder / "frames" / f"{i:03d}_depth.png", np.rint((ray - low) / (high - low) * 65535).astype(np.uint16))
    truth = {
        "depth_range": [np.float32(low), np.float32(high)],
        "coords": np.zeros((16, FRAMES, 2), np.float16),
        "traj_3d": np.asfortranarray(clip.tracks.xyz.swapaxes(0, 1)),
        "occluded": ~clip.tracks.visible.T,
        "intrinsics": normalised(clip),
        "matrix_world": poses(clip, opengl=True),
    }
    np.save(folder / f"{folder.name}.npy", truth)
    return folder


def write_folder(clip, folder):
    for i, (image, depth) in enumerate(zip(clip.video, clip.depths, strict=True)):
        put(folder / "color" / f"{10 * i}.png", image)
        put(folder / "depth" / f"{10 * i}.png", whole(depth, 1000))
    text(folder / "poses.txt", poses(clip))
    text(folder / "intrinsics.txt", clip.intrinsics[0])
    return folder


WRITERS = {
    "npz": write_npz, "result": write_result, "tapvid3d": write_tapvid3d, "megasam": write_megasam, "vggt": write_vggt,
    "tum": write_tum, "7scenes": write_7scenes, "record3d": write_record3d, "movi": write_movi, "kubric": write_kubric,
    "folder": write_folder,
}  # fmt: skip
# Largest errors of depth, relative or absolute as the format stores it, over the readers' float32.
DEPTH = {"megasam": ("rtol", 6e-4), "tum": ("atol", 1.01e-4), "7scenes": ("atol", 5.1e-4), "folder": ("atol", 5.1e-4)}
DEPTH |= {"kubric": ("atol", 2e-4)}


def same_cameras(read, clip, tolerance=1e-5):
    np.testing.assert_allclose(read.intrinsics, clip.intrinsics, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(read.extrinsics, clip.extrinsics, atol=tolerance)


def test_every_format_has_a_writer_here():
    assert set(FORMATS) == {"auto", *WRITERS}


@pytest.mark.parametrize("forced", [False, True], ids=["recognised", "forced"])
@pytest.mark.parametrize("kind", WRITERS)
def test_round_trip(clip, tmp_path, kind, forced):
    folder = tmp_path / "seq"
    folder.mkdir()
    path = WRITERS[kind](clip, folder)
    if kind == "tapvid3d":
        np.save(tmp_path / "depth.npy", clip.depths)
    read = t3d.load_clip(path, kind if forced else "auto", depth=tmp_path / "depth.npy" if kind == "tapvid3d" else None)
    same_cameras(read, clip)
    how, size = DEPTH.get(kind, ("rtol", 2e-6))
    known = whole(clip.depths, 5000) > 0 if kind == "tum" else clip.depths > 0
    assert known.mean() > 0.7 and not read.depths[~known].any()
    np.testing.assert_allclose(read.depths[known], clip.depths[known], **({"rtol": 0, "atol": 0} | {how: size}))
    if kind == "tapvid3d":
        jpegs = [cv2.imdecode(cv2.imencode(".jpg", x[..., ::-1], QUALITY)[1], cv2.IMREAD_COLOR) for x in clip.video]
        np.testing.assert_array_equal(read.video, np.stack(jpegs)[..., ::-1])
    else:
        np.testing.assert_array_equal(read.video, clip.video)
    assert read.name == (clip.name if kind == "npz" else path.stem)
    if kind in ("npz", "tapvid3d"):
        np.testing.assert_allclose(read.tracks.xyz, clip.tracks.xyz, atol=1e-5)
        np.testing.assert_array_equal(read.tracks.visible, clip.tracks.visible)
    if kind in ("npz", "tapvid3d", "result"):
        np.testing.assert_allclose(read.queries, clip.queries, atol=1e-5)
    assert t3d.check_clip(read) == [] or kind == "tapvid3d"


def test_tracks_of_the_authors_kubric_are_true(clip, tmp_path):
    read = t3d.load_clip(write_kubric(clip, tmp_path / "0007"))
    shown = clip.tracks.visible.any(0)
    np.testing.assert_allclose(read.tracks.xyz, clip.tracks.xyz[:, shown], atol=1e-6)
    np.testing.assert_array_equal(read.tracks.visible, clip.tracks.visible[:, shown])
    np.testing.assert_array_equal(read.queries[:, 0], read.tracks.visible.argmax(0))
    moving = np.ptp(read.tracks.xyz, axis=0).max(-1) > 0.01
    np.testing.assert_array_equal(read.tracks.dynamic, moving)
    assert t3d.load_clip(tmp_path / "0007", points=False).tracks is None
    part = t3d.load_clip(tmp_path / "0007", frames=slice(1, 4))
    np.testing.assert_array_equal(part.tracks.xyz[:, :1], read.tracks.xyz[1:4, :1])


def test_tapvid3d_without_poses_and_with_sparse_depth(clip, tmp_path):
    path = write_tapvid3d(clip, tmp_path)
    with pytest.raises(ValueError, match=r'holds no depth; give depth="sparse"'):
        t3d.load_clip(path)
    read = t3d.load_clip(path, depth="sparse")
    known, wanted = read.depths > 0, np.full(clip.depths.shape, np.inf, np.float32)
    for t, seen in enumerate(clip.tracks.visible):  # hidden points write nothing, and of two the nearer stays
        uv, z = project(clip.tracks.xyz[t, seen], clip.intrinsics[t], clip.extrinsics[t])
        column, row = np.rint(uv).astype(int).T
        np.minimum.at(wanted[t], (row, column), z)
    np.testing.assert_allclose(read.depths, np.where(np.isfinite(wanted), wanted, 0), rtol=1e-4)
    assert 0 < known.sum() <= clip.tracks.visible.sum() < clip.tracks.visible.size
    assert np.median(np.abs(read.depths[known] / clip.depths[known] - 1)) < 0.01
    np.testing.assert_allclose(read.tracks.xyz, clip.tracks.xyz, atol=1e-5)
    assert t3d.load_clip(path, depth="sparse", points=False).tracks is None
    arrays = dict(np.load(path, allow_pickle=True))
    np.savez(path, **{k: v for k, v in arrays.items() if k != "extrinsics_w2c"})
    still = t3d.load_clip(path, depth="sparse")
    assert (still.extrinsics == np.eye(4)).all()
    np.testing.assert_allclose(still.tracks.xyz, arrays["tracks_XYZ"], atol=1e-6)


def test_depth_anything_and_batches(clip, tmp_path):
    read = t3d.load_clip(write_depth_anything(clip, tmp_path))
    np.testing.assert_array_equal(read.depths, clip.depths)
    np.testing.assert_array_equal(read.video, clip.video)
    with np.load(write_vggt(clip, tmp_path)) as data:
        arrays = {key: data[key][None] for key in data.files}
    np.savez(tmp_path / "batch.npz", **(arrays | {"images": arrays["images"] - 1e-4}))
    batch = t3d.load_clip(tmp_path / "batch.npz")
    np.testing.assert_array_equal(batch.video, clip.video)
    np.testing.assert_array_equal(batch.extrinsics, clip.extrinsics)


def test_record3d_raw_depth_of_a_smaller_sensor(clip, tmp_path):
    small = replace(clip, queries=None, tracks=None, depths=clip.depths)
    path = write_record3d(small, tmp_path, exr=False)
    meta = json.loads((path / "metadata").read_text())
    for i, depth in enumerate(clip.depths):
        (path / "rgbd" / f"{i}.depth").write_bytes(np.ascontiguousarray(depth[::2, ::2]).tobytes())
    each = [[*fx_fy_cx_cy(clip)] for _ in range(FRAMES)]
    (path / "metadata").write_text(json.dumps(meta | {"dw": 32, "dh": 24, "perFrameIntrinsicCoeffs": each}))
    read = t3d.load_clip(path)
    np.testing.assert_array_equal(read.depths, clip.depths[:, ::2, ::2].repeat(2, 1).repeat(2, 2))
    same_cameras(read, clip)
    (path / "rgbd" / "3.depth").write_bytes(b"bvx2" + b"\0" * 50)
    with pytest.raises(ValueError, match=r"3.depth: packed by LZFSE; `pip install pyliblzfse`"):
        t3d.load_clip(path)


def test_movi_with_16_bit_depth(clip, tmp_path):
    path = write_movi(clip, tmp_path)
    low, high = float(rays(clip).min()), float(rays(clip).max())
    for i, ray in enumerate(rays(clip)):
        (path / f"depth_{i:05d}.tiff").unlink()
        put(path / f"depth_{i:05d}.png", np.rint((ray - low) / (high - low) * 65535).astype(np.uint16))
    (path / "data_ranges.json").write_text(json.dumps({"depth": {"min": low, "max": high}}))
    np.testing.assert_allclose(t3d.load_clip(path).depths, clip.depths, atol=2e-4)


def test_a_video_beside_its_depth(clip, tmp_path):
    write_folder(clip, tmp_path)
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 24.0, (64, 48))
    for image in clip.video:
        film.write(np.ascontiguousarray(image[..., ::-1]))
    film.release()
    read = t3d.load_clip(tmp_path / "film.avi")
    assert np.abs(read.video.astype(int) - clip.video).mean() < 8 and read.fps == 24
    same_cameras(read, clip)
    part = t3d.load_clip(tmp_path / "film.avi", frames=slice(1, None, 2))
    np.testing.assert_array_equal(part.video, read.video[1::2])
    np.testing.assert_array_equal(part.depths, read.depths[1::2])
    for image in (tmp_path / "color").iterdir():
        image.unlink()
    (tmp_path / "color").rmdir()
    np.testing.assert_array_equal(t3d.load_clip(tmp_path).video, read.video)


def test_the_settings_say_what_is_otherwise(clip, tmp_path):
    write_folder(clip, tmp_path)
    text(tmp_path / "poses.txt", FLIP @ clip.extrinsics.astype(np.float64))
    k = resize_intrinsics(clip.intrinsics[0].astype(np.float64), (48, 64), (96, 128))
    settings = {"poses": "world_to_camera", "axes": "opengl", "intrinsics": k.tolist(), "made_for": [128, 96], "fps": 5}
    (tmp_path / "clip.json").write_text(json.dumps(settings | {"depth_scale": 500, "depth_is": "ray"}))
    read = t3d.load_clip(tmp_path)
    same_cameras(read, clip)
    expected = whole(clip.depths, 1000) / 500 * clip.depths / np.maximum(rays(clip), 1e-9)
    np.testing.assert_allclose(read.depths, expected, rtol=1e-5)
    assert read.fps == 5


@pytest.mark.parametrize("columns", [12, 7, 8])
def test_poses_in_other_forms(clip, tmp_path, columns):
    write_folder(clip, tmp_path)
    c2w = poses(clip)
    rows = c2w[:, :3].reshape(-1, 12)
    if columns < 12:
        rows = [[*([0.1] * (columns - 7)), *p[:3, 3], *(3 * quaternion(p[:3, :3]))] for p in c2w]
    text(tmp_path / "poses.txt", rows)
    same_cameras(t3d.load_clip(tmp_path), clip)
    (tmp_path / "poses.txt").unlink()
    (tmp_path / "pose").mkdir()
    for i, pose in enumerate(c2w):
        text(tmp_path / "pose" / f"{i}.txt", pose)
    same_cameras(t3d.load_clip(tmp_path), clip)


def test_frames_named_by_their_times_may_be_apart(clip, tmp_path):
    write_folder(clip, tmp_path)
    names = ["0.10.png", "0.13.png", "0.19.png", "0.20.png", "0.31.png"]
    for folder in ("color", "depth"):
        for i, name in enumerate(names):
            (tmp_path / folder / f"{10 * i}.png").rename(tmp_path / folder / name)
    np.testing.assert_array_equal(t3d.load_clip(tmp_path).video, clip.video)
    for i, name in enumerate(names):
        (tmp_path / "color" / name).rename(tmp_path / "color" / f"{1305031102000000 + 7 * i * i}.png")
    np.testing.assert_array_equal(t3d.load_clip(tmp_path).video, clip.video)


def test_save_clip_writes_a_folder_that_loads_to_the_bit(clip, tmp_path):
    moving = clip.intrinsics.copy()
    moving[:, 0, 0] *= np.linspace(1, 1.1, FRAMES)
    zoom = replace(clip, intrinsics=moving, queries=None, tracks=None, fps=7.0)
    t3d.save_clip(zoom, tmp_path / "out")
    read = t3d.load_clip(tmp_path / "out")
    for key in ("video", "depths", "intrinsics", "extrinsics", "fps"):
        np.testing.assert_array_equal(getattr(read, key), getattr(zoom, key))
    t3d.save_clip(clip, tmp_path / "out.npz")
    np.testing.assert_array_equal(t3d.load_clip(tmp_path / "out.npz").tracks.xyz, clip.tracks.xyz)
    for bad in (tmp_path / "out", tmp_path / "out.mat"):
        with pytest.raises(ValueError, match=r"NAME.npz or as a new, empty folder"):
            t3d.save_clip(clip, bad)


def test_frames_and_depth_in_place_of_the_own(clip, tmp_path):
    (tmp_path / "a").mkdir()
    write_folder(clip, tmp_path / "a")
    np.savez(tmp_path / "z.npz", depths=2 * clip.depths, other=np.zeros(3))
    read = t3d.load_clip(tmp_path / "a", depth=tmp_path / "z.npz", frames=slice(0, 4, 3))
    np.testing.assert_array_equal(read.depths, 2 * clip.depths[:4:3])
    np.save(tmp_path / "half.npy", clip.depths[:, ::2, ::2])
    half = t3d.load_clip(tmp_path / "a", depth=tmp_path / "half.npy").depths
    np.testing.assert_array_equal(half, clip.depths[:, ::2, ::2].repeat(2, 1).repeat(2, 2))
    np.testing.assert_array_equal(read.video, clip.video[:4:3])
    clip.save(tmp_path / "c.npz")
    np.testing.assert_array_equal(t3d.load_clip(tmp_path / "c.npz", depth=tmp_path / "z.npz").depths, 2 * clip.depths)
    with pytest.raises(ValueError, match=r"c.npz: frames are chosen in folders and videos"):
        t3d.load_clip(tmp_path / "c.npz", frames=slice(2))


# --- a depth camera of its own --------------------------------------------------------------------------------------


def plane(intrinsics, pose, size, normal=(0.1, 0.2, 1.0), distance=2.0):
    """z-depth (H, W) of the plane n X = d of the colour camera's frame, seen by a camera at `pose` (from that frame)."""
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([u, v, np.ones(size)], -1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3]
    origin = -pose[:3, :3].T @ pose[:3, 3]
    return (distance - origin @ normal) / (rays @ np.array(normal))


@pytest.mark.parametrize("size", [(48, 64), (24, 32)], ids=["same size", "half"])
def test_registration_shows_what_the_colour_camera_sees(size):
    color = np.array([[52.5, 0, 31.5], [0, 52.5, 23.5], [0, 0, 1]])
    own = np.array([[58.5, 0, 31.5], [0, 58.5, 23.5], [0, 0, 1]])
    own = resize_intrinsics(own, (48, 64), size)
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.01]))[0]
    color_from_depth = np.vstack([np.c_[turn, [-0.05, 0.01, 0.02]], [0, 0, 0, 1]])
    depth = plane(own, np.linalg.inv(color_from_depth), size).astype(np.float32)
    seen = register_depth(depth, own, color, color_from_depth, (48, 64))
    truth = plane(color, np.eye(4), (48, 64))
    known = seen > 0
    assert known[8:-8, 10:-10].mean() > 0.98
    # Half a pixel (of the depth camera) beside the true ray, on a plane of this slope.
    np.testing.assert_allclose(seen[known], truth[known], rtol=0.012 * 48 / size[0])


def test_registration_keeps_the_nearest():
    k = np.array([[8, 0, 3.5], [0, 8, 0], [0, 0, 1.0]])
    shift = np.eye(4)
    depth = np.array([[4, 4, 1, 1, 4, 4, 4, 0]], np.float32)
    shift[0, 3] = 0.25  # near points move by 2 pixels, far ones by half a pixel
    seen = register_depth(depth, k, k, shift, (1, 8))[0]
    assert seen[4] == 1 and seen[5] == 1


def test_7scenes_registers_the_depth_camera(clip, tmp_path):
    write_7scenes(clip, tmp_path)
    shift = np.eye(4)
    shift[:3, 3] = [-0.02, 0, 0]
    settings = json.loads((tmp_path / "clip.json").read_text()) | {"color_from_depth": shift.tolist()}
    (tmp_path / "clip.json").write_text(json.dumps(settings))
    read = t3d.load_clip(tmp_path)
    np.testing.assert_allclose(read.extrinsics, shift @ clip.extrinsics.astype(np.float64), atol=1e-5)
    (tmp_path / "clip.json").write_text(json.dumps({"depth_intrinsics": None, "color_from_depth": None}))
    plain = t3d.load_clip(tmp_path)  # the Kinect's intrinsics, for a smaller image
    assert plain.intrinsics[0, 0, 0] == pytest.approx(52.5) and plain.intrinsics[0, 0, 2] == pytest.approx(31.55)


def test_7scenes_of_smaller_images(tmp_path):
    """The depth camera that the layout assumes is that of 640x480, too."""
    clip = t3d.simulate_clip(3, frames=3, size=(480, 640), tracks=4, moving=(1, 1), resting=(0, 0))
    for scale, folder in ((1, tmp_path / "large"), (2, tmp_path / "small")):
        for t in range(3):
            put(folder / f"frame-{t:06d}.color.png", np.ascontiguousarray(clip.video[t, ::scale, ::scale]))
            put(folder / f"frame-{t:06d}.depth.png", whole(clip.depths[t, ::scale, ::scale], 1000))
            text(folder / f"frame-{t:06d}.pose.txt", poses(clip)[t])
    large, small = (t3d.load_clip(tmp_path / name) for name in ("large", "small"))
    found = large.depths[:, ::2, ::2]
    both = (found > 0) & (small.depths > 0)
    assert both.mean() > 0.5
    assert np.median(np.abs(small.depths[both] / found[both] - 1)) < 0.01


def test_a_camera_of_another_shape_is_not_stretched(clip, tmp_path):
    write_tum(clip, tmp_path)
    (tmp_path / "intrinsics.txt").unlink(missing_ok=True)
    (tmp_path / "clip.json").unlink(missing_ok=True)
    for folder in ("rgb", "depth"):
        for path in (tmp_path / folder).glob("*.png"):
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(path), np.ascontiguousarray(image[:, : image.shape[1] // 2]))
    with pytest.raises(ValueError, match=r"640x480, which these of .* not a smaller form of; write their fx fy cx cy"):
        t3d.load_clip(tmp_path)


def test_small_things_of_other_programs(clip, tmp_path):
    path = write_movi(clip, tmp_path / "movi")
    about = json.loads((path / "metadata.json").read_text()) | {"metadata": {"frame_rate": 24}}
    (path / "metadata.json").write_text(json.dumps(about))
    assert t3d.load_clip(path).fps == 24
    (tmp_path / "mac").mkdir()
    write_folder(clip, tmp_path / "mac")
    first = next(
        x for x in (tmp_path / "mac").rglob("*.*") if x.suffix in (".png", ".jpg") and "depth" not in str(x.parent.name)
    )
    (first.parent / f"._{first.name}").write_bytes(b"macOS")
    assert len(t3d.load_clip(tmp_path / "mac")) == len(clip)
    images, top = np.moveaxis(clip.video, -1, 1) / np.float32(255), clip.extrinsics[:, :3]
    arrays = {"images": images, "depth": clip.depths[:, None], "intrinsic": clip.intrinsics[0], "extrinsic": top}
    np.savez(tmp_path / "one.npz", **arrays)
    read = t3d.load_clip(tmp_path / "one.npz")
    assert np.array_equal(read.depths, clip.depths) and np.array_equal(read.video, clip.video)
    np.savez(tmp_path / "normal.npz", **arrays | {"images": 2 * images - 1})
    with pytest.raises(ValueError, match="got negative ones; undo the normalisation"):
        t3d.load_clip(tmp_path / "normal.npz")


def test_a_folder_keeps_a_far_world(clip, tmp_path):
    far = clip.extrinsics.astype(np.float64)
    far[:, :3, 3] -= far[:, :3, :3] @ [4e6, 5e5, 300]
    moved = replace(clip, extrinsics=far, queries=None, tracks=None)
    t3d.save_clip(moved, tmp_path / "far")
    assert np.abs(t3d.load_clip(tmp_path / "far").extrinsics - far).max() < 1e-8


# --- EXR ------------------------------------------------------------------------------------------------------------


def write_exr(path, compression="ZIP_COMPRESSION", **channels):
    exr = pytest.importorskip("OpenEXR")
    exr.File({"compression": getattr(exr, compression), "type": exr.scanlineimage}, channels).write(str(path))


@pytest.mark.parametrize("compression", ["NO_COMPRESSION", "ZIP_COMPRESSION", "PIZ_COMPRESSION"])
@pytest.mark.parametrize("names", ["Z", "BGR"])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_exr(tmp_path, names, compression, kind):
    smooth = np.round(np.cumsum(np.random.default_rng(0).random((37, 23)), 1), 1).astype(kind)
    write_exr(tmp_path / "7.exr", compression, **{name: smooth + kind(i) for i, name in enumerate(names)})
    np.testing.assert_array_equal(read_depth(tmp_path / "7.exr"), smooth.astype(np.float32))


def test_a_bad_exr_is_named(tmp_path, monkeypatch):
    write_exr(tmp_path / "7.exr", Z=np.ones((20, 20), np.float32))
    good = (tmp_path / "7.exr").read_bytes()
    for bad in (good[:-90], b"\x89PNG" + good):
        (tmp_path / "7.exr").write_bytes(bad)
        with pytest.raises(ValueError, match=r"7.exr: not a readable EXR .*; write it as TIFF or npy"):
            read_depth(tmp_path / "7.exr")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ValueError, match="pip install OpenEXR"):
        read_depth(tmp_path / "7.exr")


# --- pickles --------------------------------------------------------------------------------------------------------


class Bomb:
    def __reduce__(self):
        return (exec, ("import pathlib; pathlib.Path(BOMB).touch()",))


def npy(value, protocol):
    """A pickled object array as NumPy writes it, at any protocol."""
    array, file = np.empty((), object), io.BytesIO()
    array[()] = value
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    pickle.dump(array, file, protocol=protocol)
    file.seek(0)
    return file


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_objects_are_read_without_running_them(protocol):
    nested = np.empty(2, object)
    nested[:] = [b"\xff\xd8\0", b"x"]
    value = {
        "floats": np.arange(6, dtype=np.float16).reshape(2, 3), "fortran": np.asfortranarray(np.eye(3)[:2]), "n": 3,
        "flags": np.array([True, False]), "names": np.array(["a", "bc"]), "big": np.arange(3, dtype=">i4"),
        "scalar": np.float32(2.5), "list": [np.uint8(7), (1, "t")], "bytes": b"\x80\0", "objects": nested, "none": None,
        "empty": np.zeros((0, 3)),
    }  # fmt: skip
    read = load_objects("x.npy", npy(value, protocol))
    assert read.keys() == value.keys()
    for key, expected in value.items():
        if isinstance(expected, np.ndarray):
            assert read[key].dtype == expected.dtype and read[key].shape == expected.shape, key
            np.testing.assert_array_equal(read[key], expected)
        else:
            assert read[key] == expected, key


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_a_pickle_that_would_run_code_is_refused(clip, tmp_path, protocol, monkeypatch):
    monkeypatch.setitem(__builtins__, "BOMB", str(tmp_path / "boom"))
    with pytest.raises(ValueError, match=r"x.npy: .*names \w+.exec, which such a file does not need: refused"):
        load_objects("x.npy", npy([Bomb()], protocol))
    images = np.empty(1, object)
    images[0] = Bomb()
    path = write_tapvid3d(clip, tmp_path, images_jpeg_bytes=images)
    with pytest.raises(ValueError, match=r"clip.npz: .*refused"):
        t3d.load_clip(path, depth="sparse")
    assert not (tmp_path / "boom").exists()
    np.load(path, allow_pickle=True)["images_jpeg_bytes"]  # the same file does run code there
    assert (tmp_path / "boom").exists()


@pytest.mark.parametrize(
    "call",
    [
        b"cnumpy\nndarray\n(K\x08tR.",
        b"cnumpy.core.multiarray\n_reconstruct\n(tR(U\x01Otb.",
        b"]q\x00h\x00a.",
        b"]q\x00cbuiltins\nlist\na.",
        b"N",
        b"",
    ],
)
def test_a_crafted_pickle_ends_as_an_error_or_as_data(call):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "|O", "fortran_order": False, "shape": ()})
    file.write(call)
    file.seek(0)
    with pytest.raises(ValueError, match=r"x.npy: not a readable file of arrays"):
        load_objects("x.npy", file)


# --- bad input ------------------------------------------------------------------------------------------------------


def bad_depth_8_bit(path):
    put(path / "depth" / "20.png", np.zeros((48, 64), np.uint8))
    return r"20.png: depth of shape \(48, 64\) uint8 is a picture for the eye"


def bad_depth_count(path):
    (path / "depth" / "40.png").unlink()
    return "5 colour frames, 4 of depth and 5 poses"


def bad_gap(path):
    (path / "color" / "20.png").unlink()
    return r"color: a gap after 10.png"


def bad_gap_beside_another_number(path):
    for image in (path / "color").iterdir():
        image.rename(image.with_name(f"cam2_{image.name}"))
    (path / "color" / "cam2_30.png").unlink()
    return r"color: a gap after cam2_20.png"


def bad_pose_lost(path):
    text(path / "poses.txt", [np.eye(4), np.full(16, -np.inf), np.eye(4), np.zeros(16), np.eye(4)])
    return r"poses \[1, 3\] are none \(tracking lost"


def bad_focal(path):
    text(path / "intrinsics.txt", [[0, 50, 30, 20]])
    return "intrinsics: focal lengths must be positive, got 0, 50"


def bad_intrinsics_missing(path):
    (path / "intrinsics.txt").unlink()
    return "intrinsics are not known; write fx fy cx cy"


def bad_intrinsics_count(path):
    text(path / "intrinsics.txt", [[1, 2, 3]])
    return "expected fx fy cx cy or a 3x3 matrix in rows, got 3"


def bad_depth_absent(path):
    for x in (path / "depth").iterdir():
        x.unlink()
    (path / "depth").rmdir()
    return r"depth/ missing, .*npz of MegaSaM"


def bad_depth_shape(path):
    put(path / "depth" / "20.png", np.ones((48, 48), np.uint16))
    return r"20.png: depth of 48x48 is of another shape than the 64x48 image"


def bad_image(path):
    (path / "color" / "20.png").write_bytes(b"no picture")
    return r"20.png: not a readable image"


def bad_image_empty(path):
    (path / "depth" / "20.png").write_bytes(b"")
    return r"20.png: not a readable depth image"


def bad_image_size(path):
    put(path / "color" / "20.png", np.zeros((24, 32, 3), np.uint8))
    return r"colour images of sizes \[\(32, 24\), \(64, 48\)\]"


def bad_poses(path):
    text(path / "poses.txt", np.zeros((5, 6)))
    return r"poses.txt: expected 16, 12, 8 or 7"


def bad_pose_words(path):
    (path / "poses.txt").write_text("one two\n")
    return r"poses.txt: not a readable table of numbers"


def bad_quaternion(path):
    text(path / "poses.txt", np.zeros((5, 7)))
    return "quaternion of length 0"


def bad_settings(path):
    (path / "clip.json").write_text('{"depth_units": 3}')
    return r"clip.json: unknown depth_units; known are axes"


def bad_settings_word(path):
    (path / "clip.json").write_text('{"poses": "c2w"}')
    return r"clip.json: poses must be one of \('camera_to_world', 'world_to_camera'\), got 'c2w'"


def bad_json(path):
    (path / "clip.json").write_text("{")
    return r"clip.json: not a readable JSON file"


def bad_type(path):
    (path / "clip.json").write_text('{"fps": [1]}')
    return r"not readable as folder \(TypeError"


BAD = {name[4:]: function for name, function in list(globals().items()) if name.startswith("bad_")}


@pytest.mark.parametrize("case", BAD)
def test_bad_folders_are_named(clip, tmp_path, case):
    message = BAD[case](write_folder(clip, tmp_path))
    with pytest.raises(ValueError, match=message) as caught:
        t3d.load_clip(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_bad_files_are_named(clip, tmp_path):
    write_folder(clip, tmp_path)
    (tmp_path / "film.mp4").write_bytes(b"not a film at all")
    with pytest.raises(
        ValueError, match=r"film.mp4: no frame that OpenCV can decode; if the codec is unknown, convert it"
    ):
        t3d.load_clip(tmp_path / "film.mp4")
    (tmp_path / "x.r3d").write_bytes(b"PK")
    (tmp_path / "d.npy").write_bytes(b"x")
    np.save(tmp_path / "flat.npy", np.zeros((3, 4)))
    np.savez(tmp_path / "rgb.npz", images=clip.video, depth=clip.depths)
    np.savez(tmp_path / "tracks.npz", coords=1, visibs=1, query_points=1)
    for name, options, message in [
        ("x.r3d", {}, "unzip it"),
        ("rgb.npz", {}, "needs the keys video"),
        ("rgb.npz", {"format": "vggt"}, "intrinsic, extrinsic missing"),
        ("rgb.npz", {"format": "megasam"}, "cam_c2w missing"),
        ("rgb.npz", {"format": "tum"}, "format tum is that of a folder"),
        ("depth", {"format": "npz"}, "format npz is that of a file"),
        ("tracks.npz", {}, "a result with its clip needs"),
        ("rgb.npz", {"format": "zarr"}, "format: expected one of auto, npz"),
        ("", {"depth": tmp_path / "d.npy"}, "d.npy: not a readable npy"),
        ("", {"depth": tmp_path / "flat.npy"}, r"flat.npy: expected depth \(T, H, W\)"),
        ("", {"frames": slice(99, None)}, "colour images of sizes none"),
        ("", {"frames": slice(-3, None)}, "without negative numbers"),
        ("absent", {}, "no such file"),
    ]:
        with pytest.raises(ValueError, match=message):
            t3d.load_clip(tmp_path / name, **options)


def test_bad_time_stamps_are_named(clip, tmp_path):
    write_tum(clip, tmp_path)
    good = (tmp_path / "groundtruth.txt").read_text()
    text(tmp_path / "groundtruth.txt", np.zeros((5, 7)))
    with pytest.raises(ValueError, match=r"expected lines in rgb.txt, depth.txt, groundtruth.txt \(time tx"):
        t3d.load_clip(tmp_path)
    text(tmp_path / "groundtruth.txt", np.ones((5, 8)))
    with pytest.raises(ValueError, match=r"only 0 of 5 colour frames have depth within 20 ms and a pose within 100 ms"):
        t3d.load_clip(tmp_path)
    (tmp_path / "groundtruth.txt").write_text(good)
    listed = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join(listed[:-1]))
    assert len(t3d.load_clip(tmp_path)) == 4  # a colour frame without depth is left out, as sensors lose some
    (tmp_path / "rgb.txt").write_text("rgb/0.png\n")
    with pytest.raises(ValueError, match=r"rgb.txt: expected lines of a time stamp and a file"):
        t3d.load_clip(tmp_path)


def test_tum_poses_between_stamps_are_interpolated(clip, tmp_path):
    write_tum(clip, tmp_path)
    lines = (tmp_path / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "groundtruth.txt").write_text("\n".join(x for i, x in enumerate(lines) if i != 3))
    read, c2w = t3d.load_clip(tmp_path), poses(clip)
    np.testing.assert_allclose(invert(read.extrinsics)[2, :3, 3], (c2w[1] + c2w[3])[:3, 3] / 2, atol=1e-5)
    between = (clip.extrinsics[1] + clip.extrinsics[3])[:3, :3] / 2
    np.testing.assert_allclose(read.extrinsics[2, :3, :3], between, atol=0.01)
    same = [0, 1, 3, 4]
    np.testing.assert_allclose(read.extrinsics[same], clip.extrinsics[same], atol=1e-5)
    assert read.fps == pytest.approx(30, rel=1e-3)


def test_a_zip_that_is_no_npz_is_named(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(ValueError, match=r"a.npz"):
        t3d.load_clip(tmp_path / "a.npz")
