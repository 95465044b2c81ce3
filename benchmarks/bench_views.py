"""Time the geometry kit on one core: `python benchmarks/bench_views.py`.

One cloud comes from four synthetic depth cameras around a table with boxes, so that points are
ordered and overlap as in real observations; the other is the worst case. Views and decoding are
checked against plain versions of the same result, which are also timed: views in torch, by
scattering the nearest depth, and in numpy, by drawing all points from the farthest to the nearest.
"""

import functools
import itertools
import os
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64

from baselines import heatmap
from baselines.scene import augment, cloud, views
from sacil_tasks.interface import SCENE_BOUNDS

POINTS = 53_000
BOXES = (  # centre x, y and half sizes x, y, height (m)
    (0.45, -0.15, 0.02, 0.02, 0.04),
    (0.55, 0.05, 0.03, 0.03, 0.06),
    (0.60, 0.20, 0.04, 0.04, 0.08),
    (0.75, -0.05, 0.08, 0.15, 0.36),
)
EYES = ((1.2, 0.0, 0.7), (0.2, 0.6, 0.7), (0.2, -0.6, 0.7), (0.45, 0.0, 0.5))


def look_at(eye: np.ndarray, target: np.ndarray) -> Float32[np.ndarray, "4 4"]:
    """Pose of a camera (x right, y down, z forward) that looks at a point."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.1, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4, dtype=np.float32)
    pose[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
    return pose


def ray_depth_mm(pose: Float32[np.ndarray, "4 4"], pixels: int, focal: float) -> np.ndarray:
    """Depth image (mm) of the table and its boxes; 0 where a ray leaves the scene."""
    v, u = (np.mgrid[:pixels, :pixels] + 0.5 - pixels / 2) / focal
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ pose[:3, :3].T.astype(np.float64)
    eye = pose[:3, 3].astype(np.float64)
    boxes = [((x - a, y - b, 0.0), (x + a, y + b, h)) for x, y, a, b, h in BOXES]
    boxes.append(((0.0, -0.5, -0.1), (0.95, 0.5, 0.0)))  # the table
    depth = np.full(u.shape, np.inf)
    for low, high in boxes:
        first, second = (np.array(low) - eye) / rays, (np.array(high) - eye) / rays
        enter = np.minimum(first, second).max(axis=-1)
        leave = np.maximum(first, second).min(axis=-1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    return np.where(np.isfinite(depth), 1000 * depth, 0).astype(np.uint16)


def observe(pixels: int = 128, focal: float = 150.0) -> tuple[np.ndarray, ...]:
    """Colours, depth, intrinsics and poses of the four cameras."""
    target = np.array((0.55, 0.0, 0.1))
    poses = np.stack([look_at(np.array(eye), target) for eye in EYES])
    depth_mm = np.stack([ray_depth_mm(pose, pixels, focal) for pose in poses])
    half = pixels / 2
    pinhole = np.array([[focal, 0, half], [0, focal, half], [0, 0, 1]], np.float32)
    rgb = np.random.default_rng(0).integers(0, 256, (*depth_mm.shape, 3), dtype=np.uint8)
    return rgb, depth_mm, np.stack([pinhole] * len(poses)), poses


def torch_views(
    xyz: Float32[np.ndarray, "n 3"],
    rgb: np.ndarray,
    transform: np.ndarray,
    pixels: int,
    chosen: tuple[views.View, ...],
) -> Float[torch.Tensor, "v 7 h w"]:
    """The same picture in torch: (depth, index) packed in one integer, scattered by minimum."""
    x, y, z = torch.from_numpy(xyz).unbind(-1)
    rows = torch.from_numpy(transform)
    placed = torch.stack([r[0] * x + r[1] * y + r[2] * z + r[3] for r in rows], dim=-1)
    kept = (placed.abs() <= 1).all(dim=-1)
    placed = placed[kept]
    features = torch.cat([placed, torch.from_numpy(rgb)[kept] / 255], dim=-1)
    cells = (pixels / 2 * (1 + placed) + 0.5).long()
    return torch.stack([_torch_view(features, cells, view, pixels) for view in chosen])


def _torch_view(
    features: Float[torch.Tensor, "n 6"],
    cells: Int64[torch.Tensor, "n 3"],
    view: views.View,
    pixels: int,
) -> Float[torch.Tensor, "7 h w"]:
    depth = 1 - view.side * features[:, view.depth_axis]
    keys = (depth.double() * 2**24).long() << 32 | torch.arange(len(depth))
    side = pixels + 2
    first = cells[:, view.v_axis] * side + cells[:, view.u_axis]
    nearest = torch.full((side * side,), 2**62)
    for step in (0, 1, side, side + 1):
        nearest.scatter_reduce_(0, first + step, keys, "amin")
    nearest = nearest.view(side, side)[1:-1, 1:-1].flip(0)
    nearest = nearest if view.u_sign > 0 else nearest.flip(1)
    seen: Bool[torch.Tensor, "h w"] = nearest < 2**62
    winner = torch.where(seen, nearest & (2**32 - 1), 0)
    seen_depth = depth[winner]
    relative = seen_depth - seen_depth[seen].double().mean().float()
    colours = features[winner].permute(2, 0, 1) * seen
    return torch.cat([colours, torch.where(seen, relative, views.EMPTY_DEPTH)[None]])


def numpy_views(
    xyz: Float32[np.ndarray, "n 3"],
    rgb: np.ndarray,
    transform: np.ndarray,
    pixels: int,
    chosen: tuple[views.View, ...],
) -> Float32[np.ndarray, "v 7 h w"]:
    """The same picture in numpy: points are sorted by depth and the nearest is drawn last."""
    placed = np.stack([sum(r[i] * xyz[:, i] for i in range(3)) + r[3] for r in transform], axis=-1)
    kept = (np.abs(placed) <= 1).all(axis=-1)
    placed = placed[kept]
    features = np.concatenate([placed, rgb[kept] / np.float32(255)], axis=-1)
    cells = (np.float32(pixels / 2) * (1 + placed) + np.float32(0.5)).astype(np.int64)
    return np.stack([_numpy_view(features, cells, view, pixels) for view in chosen])


def _numpy_view(
    features: Float32[np.ndarray, "n 6"], cells: np.ndarray, view: views.View, pixels: int
) -> Float32[np.ndarray, "7 h w"]:
    depth = 1 - view.side * features[:, view.depth_axis]
    order = np.argsort(depth, kind="stable")[::-1]  # of equal ones the first is drawn last
    side = pixels + 2
    first = (cells[:, view.v_axis] * side + cells[:, view.u_axis])[order]
    winner = np.full(side * side, -1)
    corners = first[:, None] + np.array([0, 1, side, side + 1])
    winner[corners.ravel()] = np.repeat(order, 4)
    winner = winner.reshape(side, side)[1:-1, 1:-1][::-1, :: view.u_sign]
    seen = winner >= 0
    relative = depth[winner] - depth[winner][seen].mean(dtype=np.float64).astype(np.float32)
    colours = features[winner].transpose(2, 0, 1) * seen
    return np.concatenate([colours, np.where(seen, relative, views.EMPTY_DEPTH)[None]])


def torch_best_cell(logits: Float[torch.Tensor, "1 5 h w"]) -> int:
    """Arg-max over the whole grid with every score in memory."""
    xy, xz, yz = (plane[0] for plane in heatmap.score_planes(logits))
    return int((xy[:, :, None] + xz[:, None, :] + yz[None, :, :]).argmax())


def median_ms(call: Callable[[], object], rounds: int = 41) -> float:
    """Median processor time of one call in milliseconds, after two warm-up calls.

    Everything here runs on one thread, so this is the wall time of an idle core.
    """
    times = []
    for _ in range(rounds + 2):
        start = time.thread_time()
        call()
        times.append(1000 * (time.thread_time() - start))
    return statistics.median(times[2:])


def report(label: str, fast: Callable[[], object], *slow: Callable[[], object]) -> None:
    """Print one row: time, and how many times longer each plain version takes."""
    took = median_ms(fast)
    ratios = "".join(f"{median_ms(call, rounds=7) / took:8.1f}x" for call in slow)
    print(f"  {label:38}{took:9.3f}{ratios}", flush=True)


def time_views(
    label: str, xyz: np.ndarray, rgb: np.ndarray, pixels: int, chosen: tuple[views.View, ...]
) -> None:
    """Check and time some views of one cloud under one augmentation."""
    transform = draw_matrix(np.random.default_rng(0))
    out = np.empty((len(chosen), 7, pixels, pixels), np.float32)
    views.render_views(xyz, rgb, transform, pixels, out, chosen)
    expected = torch_views(xyz, rgb, transform, pixels, chosen)
    different = int((torch.from_numpy(out) != expected).sum())
    others = int((out != numpy_views(xyz, rgb, transform, pixels, chosen)).sum())
    covered = np.mean(out[:, 6] != views.EMPTY_DEPTH)
    print(f"{label}: {len(xyz)} points, {covered:.0%} covered")
    print(f"  values that differ from torch: {different}, from numpy: {others}")
    report(
        f"{len(chosen)} views of {pixels} px",
        lambda: views.render_views(xyz, rgb, transform, pixels, out, chosen),
        lambda: torch_views(xyz, rgb, transform, pixels, chosen),
        lambda: numpy_views(xyz, rgb, transform, pixels, chosen),
    )


def time_heatmaps(pixels: int) -> None:
    """Time targets and decoding; the best cell is compared with the whole grid in memory."""
    points = 2 * torch.rand(16, 3) - 1
    report(f"16 target heatmaps, {pixels} px", lambda: heatmap.target_heatmaps(points, pixels))
    peaked = (heatmap.target_heatmaps(points[:1], pixels) + 1e-6).log()
    noise = torch.randn(1, 5, pixels, pixels)
    for label, logits in (("peaked", peaked), ("noise", noise)):
        # sharpened so that the mean about the best cell is that cell
        best = ((heatmap.decode(1000 * logits)[0] + 1) * pixels / 2 - 0.5).round().long()
        cell = np.unravel_index(torch_best_cell(1000 * logits), (pixels,) * 3)
        assert best.tolist() == list(cell), "decoding differs from the whole grid"
        report(
            f"decode one sample, {pixels} px, {label}",
            functools.partial(heatmap.decode, logits),
            functools.partial(torch_best_cell, logits),
        )


def draw_matrix(rng: np.random.Generator) -> np.ndarray:
    """One augmentation as the renderer takes it."""
    return augment.draw(rng, np.array([0.55, 0.05, 0.05]), augment.AugmentConfig()).to_cube()


def main() -> None:
    """Time and check everything once."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    torch.set_num_threads(1)
    print(f"  {'one core':38}ms (median)   torch    numpy")
    sensors, rng = observe(), np.random.default_rng(0)
    scene = cloud.unproject(*sensors)
    report("cloud from 4 images of 128 x 128 px", lambda: cloud.unproject(*sensors))
    report("draw an augmentation", lambda: draw_matrix(rng))
    center, half = np.array(SCENE_BOUNDS.center_in_base), SCENE_BOUNDS.side_m / 2
    uniform = (center + rng.uniform(-half, half, (POINTS, 3))).astype(np.float32)
    colours = rng.integers(0, 256, uniform.shape, dtype=np.uint8)
    for pixels, chosen in itertools.product((128, 220), (views.VIEWS, views.THREE_VIEWS)):
        points = scene.xyz_in_base[:POINTS], scene.rgb[:POINTS]
        time_views("table and boxes", *points, pixels, chosen)
        time_views("uniform in the cube, no order", uniform, colours, pixels, chosen)
    for pixels in (128, 220):
        time_heatmaps(pixels)


if __name__ == "__main__":
    main()
