"""Tracks for other programs: tables, meshes, films. The suffix decides, and an unknown one is an error."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tapip3d_lite.clip import Clip, Tracks
from tapip3d_lite.figures.flat import check_drawable, track_colors
from tapip3d_lite.files import atomic_path, check_suffix, for_opencv
from tapip3d_lite.geometry import invert, point_map, project, transform

_TAIL = 8  # frames


def export_tracks(tracks: Tracks, path: str | Path, clip: Clip) -> None:
    """Write the tracks of a clip, atomically, as what the suffix says.

    - `.npz`: the authors' result, with all that their viewer needs.
    - `.csv`: a line for each frame and track: frame, track, x, y, z (world), visible, u, v (pixels; empty behind the camera).
    - `.ply`: points with colours, `frame`, `track` and `visible`, and edges along the tracks (binary; world coordinates).
    - `.mp4` (MPEG-4), `.gif` (256 fixed colours): the video with the points, filled where visible, and their tails.
    - `.glb`: the first frame's points and a line for each track, for Blender and others, in the first camera's
      frame with y up and z backwards, as glTF has it (needs trimesh).
    - `.rrd`: video, depth, camera, points and tails over the frames, for the Rerun viewer (needs rerun-sdk).

    Raises:
        ValueError: another suffix, tracks of another length than the clip's, a package that is not installed, or OpenCV
            cannot write the film.
    """
    write = WRITERS[check_export(path)]
    check_drawable(clip, tracks)
    with atomic_path(path) as temporary:
        write(tracks, temporary, clip)


def check_export(path: str | Path) -> str:
    """The suffix of a file to write; ValueError where it is unknown, its package is missing, or nothing can be written there."""
    suffix, parent = check_suffix(path, *WRITERS), Path(path).resolve().parent
    for kind, package in ((".glb", ("trimesh", "trimesh")), (".rrd", ("rerun", "rerun-sdk"))):
        if suffix == kind:
            _extra(*package)
    if parent.exists() and not (parent.is_dir() and os.access(parent, os.W_OK)):
        raise ValueError(f"{path}: {parent} is no folder in which files can be written; choose another")
    return suffix


def _csv(tracks: Tracks, path: Path, clip: Clip) -> None:
    frames, count = tracks.visible.shape
    t, n = np.divmod(np.arange(frames * count), count)
    uv, z = project(tracks.xyz, clip.intrinsics, clip.extrinsics)
    uv = np.where(z[..., None] > 0, uv, np.nan).reshape(-1, 2)
    lines, head = io.StringIO(), "frame,track,x,y,z,visible,u,v"
    rows = np.column_stack([t, n, tracks.xyz.reshape(-1, 3), tracks.visible.ravel(), uv])
    np.savetxt(lines, rows, fmt="%d,%d,%.7g,%.7g,%.7g,%d,%.3f,%.3f", header=head, comments="")
    path.write_text(lines.getvalue().replace("nan", ""), encoding="utf-8")


def _ply(tracks: Tracks, path: Path, clip: Clip) -> None:
    frames, count = tracks.visible.shape
    fields = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "visible")]
    vertices = np.zeros((frames, count), [*fields, ("frame", "<i4"), ("track", "<i4")])
    for name, values in zip("xyz", np.moveaxis(tracks.xyz, -1, 0), strict=True):
        vertices[name] = values
    for name, values in zip(("red", "green", "blue"), track_colors(clip, tracks).T, strict=True):
        vertices[name] = np.rint(values * 255)
    vertices["visible"], vertices["track"] = tracks.visible, np.arange(count)
    vertices["frame"] = np.arange(frames)[:, None]
    index = np.arange(frames * count, dtype="<i4").reshape(frames, count)
    edges = np.stack([index[:-1], index[1:]], -1).reshape(-1, 2)
    kinds = {"<f4": "float", "<i4": "int", "|u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {vertices.size}"]
    head += [f"property {kinds[vertices.dtype[name].str]} {name}" for name in vertices.dtype.names]
    head += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2", "end_header\n"]
    path.write_bytes("\n".join(head).encode() + vertices.tobytes() + edges.tobytes())


def overlay(tracks: Tracks, clip: Clip) -> np.ndarray:
    """The video (T, H', W', 3) uint8 with the points, filled where visible, and their tails; small images are enlarged."""
    scale = max(1, round(480 / clip.size[0]))
    colors = (track_colors(clip, tracks) * 255).astype(int).tolist()
    uv, z = project(tracks.xyz, clip.intrinsics, clip.extrinsics)
    # Subpixel drawing: 4 bits after the point. A point out of sight is far away, so it needs no test.
    places = np.where(((z > 0) & np.isfinite(uv).all(-1))[..., None], ((uv + 0.5) * scale - 0.5) * 16, -1e6)
    places = np.rint(np.clip(places, -1e6, 1e6)).astype(int)
    shown = clip.video.repeat(scale, 1).repeat(scale, 2)
    for t, image in enumerate(shown):
        for n, color in enumerate(colors):
            line = places[max(0, t - _TAIL) : t + 1, n]
            line = line[(line > -1e6).all(-1)].reshape(-1, 1, 2).astype(np.int32)
            cv2.polylines(image, [line], False, color, 1, cv2.LINE_AA, 4)
            where, filled = tuple(places[t, n].tolist()), cv2.FILLED if tracks.visible[t, n] else 1
            cv2.circle(image, where, 3 * 16, color, filled, cv2.LINE_AA, 4)
    return shown


def _mp4(tracks: Tracks, path: Path, clip: Clip) -> None:
    film = overlay(tracks, clip)
    film = film[:, : film.shape[1] // 2 * 2, : film.shape[2] // 2 * 2]  # the codec wants even sizes
    writer = cv2.VideoWriter(for_opencv(path), cv2.VideoWriter_fourcc(*"mp4v"), clip.fps, film.shape[2:0:-1])
    if not writer.isOpened():
        raise ValueError(f"{path}: this OpenCV writes no MP4; choose .gif")
    for image in film:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()


def _gif(tracks: Tracks, path: Path, clip: Clip) -> None:
    film = cv2.Animation()
    film.frames = [np.ascontiguousarray(image[..., ::-1]) for image in overlay(tracks, clip)]
    film.durations = [max(round(1000 / clip.fps), 20)] * len(clip)  # browsers slow down what is faster
    if not cv2.imwriteanimation(for_opencv(path), film):
        raise ValueError(f"{path}: this OpenCV writes no GIF; choose .mp4")


def _glb(tracks: Tracks, path: Path, clip: Clip) -> None:
    trimesh = _extra("trimesh", "trimesh")
    scene, paths = trimesh.Scene(), transform(tracks.xyz, clip.extrinsics[0]) * [1, -1, -1]
    places, shades = _seen_points(clip, 0)
    cloud = trimesh.PointCloud(transform(places, clip.extrinsics[0]) * [1, -1, -1], shades)
    scene.add_geometry(cloud, node_name="frame 0")
    for n, color in enumerate((track_colors(clip, tracks) * 255).astype(np.uint8)):
        line = trimesh.path.entities.Line(np.arange(len(clip)), color=[*color.tolist(), 255])
        scene.add_geometry(trimesh.path.Path3D([line], paths[:, n], process=False), f"track {n}", f"track {n}")
    path.write_bytes(scene.export(file_type="glb"))


def _rrd(tracks: Tracks, path: Path, clip: Clip) -> None:
    rr = _extra("rerun", "rerun-sdk")
    colors, film = track_colors(clip, tracks), rr.RecordingStream("tapip3d_lite")
    film.save(path)
    film.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
    for t in range(len(clip)):
        film.set_time("frame", sequence=t)
        pose = invert(clip.extrinsics[t])
        film.log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        film.log("world/camera/image", rr.Pinhole(image_from_camera=clip.intrinsics[t], resolution=clip.size[::-1]))
        film.log("world/camera/image/video", rr.Image(clip.video[t]))
        film.log("world/camera/image/depth", rr.DepthImage(clip.depths[t], meter=1.0))
        seen, tails = tracks.visible[t], np.moveaxis(tracks.xyz[max(0, t - _TAIL) : t + 1], 1, 0)
        film.log("world/tracks/visible", rr.Points3D(tracks.xyz[t, seen], colors=colors[seen]))
        film.log("world/tracks/hidden", rr.Points3D(tracks.xyz[t, ~seen], colors=colors[~seen] / 2))
        film.log("world/tracks/tails", rr.LineStrips3D(tails, colors=colors))
    film.disconnect()


def serve_tracks(tracks: Tracks, clip: Clip, port: int = 8080) -> Any:
    """Show tracks in a browser by viser, with a slider over the frames; `stop()` of what is returned ends it.

    ValueError where viser is not installed or tracks are not the clip's.
    """
    check_drawable(clip, tracks)
    server, colors = _extra("viser", "viser").ViserServer(port=port), track_colors(clip, tracks)
    pose = invert(clip.extrinsics[0])

    @server.on_client_connect
    def _(client: Any) -> None:  # behind the first camera, which looks along z with y down
        client.camera.up_direction = -pose[:3, 1]
        client.camera.position = pose[:3, 3] - 0.3 * pose[:3, 2]
        client.camera.look_at = pose[:3, 3] + pose[:3, 2]

    slider = server.gui.add_slider("frame", 0, len(clip) - 1, 1, 0)

    def show(_: Any = None) -> None:
        t = int(slider.value)
        places, shades = _seen_points(clip, t)
        server.scene.add_point_cloud("surfaces", places, shades, point_size=0.012)
        shown = colors * np.where(tracks.visible[t], 1, 0.5)[:, None]
        server.scene.add_point_cloud("tracks", tracks.xyz[t], shown, point_size=0.02)
        tails = tracks.xyz[max(0, t - _TAIL) : t + 1]
        pieces = np.stack([tails[:-1], tails[1:]], 2).reshape(-1, 2, 3)
        server.scene.add_line_segments("tails", pieces, np.tile(colors[:, None], (len(tails) - 1, 2, 1)))

    slider.on_update(show)
    show()
    return server


def _seen_points(clip: Clip, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (P, 3) of a frame's known depths, and their colours (P, 3) uint8."""
    known = clip.depths[t] > 0
    return point_map(clip.depths[t], clip.intrinsics[t], clip.extrinsics[t])[known], clip.video[t][known]


def _extra(module: str, package: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        raise ValueError(f"this needs `pip install {package}`, which is not installed") from None


WRITERS: dict[str, Callable[[Tracks, Path, Clip], None]] = {
    ".npz": Tracks.save,
    ".csv": _csv,
    ".ply": _ply,
    ".mp4": _mp4,
    ".gif": _gif,
    ".glb": _glb,
    ".rrd": _rrd,
}
