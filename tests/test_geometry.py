"""Cameras and rigid motions, against explicit loops and against themselves."""

import numpy as np
import pytest
import torch

from tapip3d_lite.geometry import (
    RASTER,
    THRESHOLDS,
    in_image,
    invert,
    look_at,
    pixel_grid,
    point_map,
    project,
    resize_intrinsics,
    transform,
    unproject,
)


def random_pose(rng, *batch):
    q, r = np.linalg.qr(rng.normal(size=(*batch, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]
    q[..., 0] *= np.linalg.det(q)[..., None]
    pose = np.zeros((*batch, 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = q, rng.normal(size=(*batch, 3)), 1
    return pose


def random_intrinsics(rng, *batch):
    matrix = np.zeros((*batch, 3, 3))
    matrix[..., 0, 0], matrix[..., 1, 1] = rng.uniform(50, 300, batch), rng.uniform(50, 300, batch)
    matrix[..., 0, 1] = rng.normal(size=batch)
    matrix[..., 0, 2], matrix[..., 1, 2], matrix[..., 2, 2] = rng.uniform(20, 90, batch), rng.uniform(20, 90, batch), 1
    return matrix


def test_transform_is_the_loop():
    rng = np.random.default_rng(0)
    points, poses = rng.normal(size=(3, 5, 3)), random_pose(rng, 3)
    expected = np.array([[(poses[b] @ [*x, 1])[:3] for x in points[b]] for b in range(3)])
    np.testing.assert_allclose(transform(points, poses), expected, atol=1e-12)


def test_project_is_the_matrix_formula():
    rng = np.random.default_rng(1)
    points, k, e = rng.normal(size=(2, 7, 3)), random_intrinsics(rng, 2), random_pose(rng, 2)
    e[:, 2, 3] += 6
    uv, z = project(points, k, e)
    for b in range(2):
        for n in range(7):
            camera = (e[b] @ [*points[b, n], 1])[:3]
            pixel = k[b] @ camera
            np.testing.assert_allclose([*uv[b, n], z[b, n]], [*(pixel[:2] / pixel[2]), camera[2]], rtol=1e-10)


def test_invert():
    pose = random_pose(np.random.default_rng(2), 4, 2)
    np.testing.assert_allclose(invert(pose) @ pose, np.broadcast_to(np.eye(4), pose.shape), atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("library", ["numpy", "torch"])
def test_round_trip_error_is_below_1e_5_of_the_depth(dtype, library):
    rng = np.random.default_rng(3)
    depth = rng.uniform(0.5, 20, (4, 12, 17)).astype(dtype)
    k, e = random_intrinsics(rng, 4).astype(dtype), random_pose(rng, 4).astype(dtype)
    if library == "torch":
        depth, k, e = map(torch.from_numpy, (depth, k, e))
    points = point_map(depth, k, e)
    assert points.dtype == depth.dtype and tuple(points.shape) == (4, 12, 17, 3)
    uv, z = project(points.reshape(4, -1, 3), k, e)
    again = unproject(uv, z, k, e)
    error = abs(again - points.reshape(4, -1, 3)) / depth.reshape(4, -1, 1)
    assert error.max() < 1e-5
    assert (abs(z - depth.reshape(4, -1)) / depth.reshape(4, -1)).max() < 1e-5


def test_numpy_and_torch_agree_and_pixel_centres_are_integers():
    depth = np.full((2, 3), 2.0)
    k = np.array([[10.0, 0, 1], [0, 20, 1], [0, 0, 1]])
    points = point_map(depth, k)
    np.testing.assert_array_equal(points[1, 1], [0, 0, 2])  # the pixel (1, 1) is the principal point
    np.testing.assert_allclose(points[0, 2], [2 * 1 / 10, -2 * 1 / 20, 2])
    np.testing.assert_array_equal(point_map(torch.from_numpy(depth), torch.from_numpy(k)).numpy(), points)
    assert pixel_grid(2, 3, depth)[1, 2].tolist() == [2, 1]


def test_gradients_flow_through_projection():
    points = torch.tensor([[0.1, 0.2, 3.0]], dtype=torch.float64, requires_grad=True)
    k = torch.tensor([[9.0, 0, 4], [0, 9, 4], [0, 0, 1]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda p: project(p, k)[0], points)


def test_points_behind_the_camera_stay_finite_and_keep_their_sign():
    uv, z = project(np.array([[1.0, 1, -2], [0, 0, 0]]), np.eye(3))
    assert np.isfinite(uv).all()
    assert z.tolist() == [-2, 0]


def test_resized_intrinsics_keep_the_image_edges_or_on_demand_the_corner_pixels():
    rng = np.random.default_rng(4)
    k = random_intrinsics(rng, 3)
    for corners, before, after in ((False, [63.5, 47.5], [99.5, 23.5]), (True, [63, 47], [99, 23])):
        resized = resize_intrinsics(k, (48, 64), (24, 100), corners)
        for start, end in ((before, after), (([-0.5] * 2,) * 2, ([0.0] * 2,) * 2)[corners]):
            point = unproject(np.array([[start]] * 3), np.full((3, 1), 2.0), k)
            uv, _ = project(point, resized)
            np.testing.assert_allclose(uv, np.array([[end]] * 3), atol=1e-9)
    np.testing.assert_allclose(resize_intrinsics(resize_intrinsics(k, (48, 64), (7, 9)), (7, 9), (48, 64)), k)
    as_torch = resize_intrinsics(torch.from_numpy(k), (48, 64), (24, 100)).numpy()
    np.testing.assert_allclose(as_torch, resize_intrinsics(k, (48, 64), (24, 100)))
    with pytest.raises(ValueError, match="at least 2"):
        resize_intrinsics(k, (1, 64), (24, 100), corners=True)
    with pytest.raises(ValueError, match="at least 1"):
        resize_intrinsics(k, (0, 64), (24, 100))


def test_look_at_puts_the_target_on_the_axis_and_up_upwards():
    eye, target = np.array([[3.0, -4, 2]]), np.array([[0.0, 0, 0.5]])
    e = look_at(eye, target, np.array([0.0, 0, 1]))
    np.testing.assert_allclose(transform(eye[:, None], e), 0, atol=1e-12)
    x, y, z = transform(target[:, None], e)[0, 0]
    np.testing.assert_allclose([x, y, z], [0, 0, np.linalg.norm(eye - target)], atol=1e-12)
    above = transform(target[:, None] + [0, 0, 0.1], e)[0, 0]
    assert above[1] < 0  # OpenCV's y points down
    np.testing.assert_allclose(np.linalg.det(e[:, :3, :3]), 1)
    as_torch = look_at(torch.from_numpy(eye), torch.from_numpy(target), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    np.testing.assert_allclose(as_torch.numpy(), e, atol=1e-12)


@pytest.mark.parametrize(("eye", "target"), [([0, 0, 1.0], [0, 0, 1.0]), ([0, 0, 1.0], [0, 0, 3.0])])
def test_look_at_refuses_degenerate_views(eye, target):
    with pytest.raises(ValueError, match="parallel"):
        look_at(np.array(eye), np.array(target), np.array([0.0, 0, 1]))


def test_in_image_is_the_loop():
    """Borders lie half a pixel outside the centres of the outer pixels, and belong to nobody."""
    k = np.array([[2.0, 0, 2.5], [0, 4.0, 1.5], [0, 0, 1]])
    pose = look_at(np.array([1.0, 2, 3]), np.array([2.0, 2, 5]), np.array([0, 1.0, 0.0]))
    places = [(u, v, z) for u in (-0.75, -0.5, 0, 5, 5.5, 6) for v in (-1, -0.5, 0, 3, 3.5, 4) for z in (-2.0, 2.0)]
    camera = np.array([[(u - 2.5) / 2 * z, (v - 1.5) / 4 * z, z] for u, v, z in places])
    expected = np.array([z > 0 and -0.5 < u < 5.5 and -0.5 < v < 3.5 for u, v, z in places])
    assert (in_image(camera[None], k[None], np.eye(4)[None], (4, 6))[0] == expected).all()
    inner = np.abs(np.array(places)[:, :2] % 1 - 0.5) > 1e-9  # borders may round to either side
    world = transform(camera, invert(pose))
    found = in_image(world[None], k[None], pose[None], (4, 6))[0]
    assert (found == expected)[inner.all(-1)].all()


def test_look_at_is_rigid_and_the_benchmarks_numbers_are_theirs():
    pose = look_at(np.array([1.0, 2, 3]), np.array([2.0, 2, 5]), np.array([0, 1.0, 0.0]))
    assert pose[3].tolist() == [0, 0, 0, 1] and np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert THRESHOLDS == (1, 2, 4, 8, 16) and RASTER == 256
