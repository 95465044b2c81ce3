"""Where the gripper goes: one heatmap per view to train on, one point in the cube to act on.

Labels, decoding and rendering share `views.project`: cell (i, j, k) of the pixels^3 grid projects
to the centre of one pixel in each view, so scores are read without interpolation.

Decoding adds the views' log-softmaxes (D-decode: RVT averages softmaxes). Each view is constant
along its own axis, so the score of a cell is A(x, y) + B(x, z) + C(y, z): exact over the whole
grid at the cost of three images.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from baselines.scene.compiled import compiled
from baselines.scene.views import VIEWS, View, project

SIGMA_PX = 1.5
"""Width of the target heatmap in pixels, as in RVT."""

CUTOFF_SIGMAS = 3.0
"""The target is 0 further than this from the label."""

REFINE_CELLS = 2
"""Cells to either side of the best one that enter the sub-cell mean (5^3 in all)."""


def target_heatmaps(
    points_in_cube: Float[torch.Tensor, "b 3"],
    pixels: int,
    sigma_px: float = SIGMA_PX,
    views: Sequence[View] = VIEWS,
) -> Float[torch.Tensor, "b v h w"]:
    """Gaussians about the projections of the labels; each view sums to 1.

    Only the small window that is not zero is computed. Labels must lie in the cube.
    """
    reach = math.ceil(CUTOFF_SIGMAS * sigma_px)
    uv = project(points_in_cube, pixels, views)[..., None]
    window = uv.floor() + torch.arange(-reach, reach + 1, device=uv.device)
    heights = torch.exp((window + 0.5 - uv).square() / (-2 * sigma_px**2))
    heights = heights * ((window >= 0) & (window < pixels))
    along_u, along_v = heights.unbind(dim=2)
    patches = along_v[..., :, None] * along_u[..., None, :]
    patches = patches * (patches >= math.exp(-(CUTOFF_SIGMAS**2) / 2))
    patches = patches / patches.sum(dim=(-2, -1), keepdim=True)
    columns, rows = window.clamp(0, pixels - 1).long().unbind(dim=2)
    where = rows[..., :, None] * pixels + columns[..., None, :]
    maps = patches.new_zeros(*uv.shape[:2], pixels * pixels)
    maps.scatter_add_(-1, where.flatten(-2), patches.flatten(-2))
    return maps.unflatten(-1, (pixels, pixels))


@torch.no_grad()
def decode(
    logits: Float[torch.Tensor, "b v h w"], views: Sequence[View] = VIEWS
) -> Float[torch.Tensor, "b 3"]:
    """The cube point on which the views agree best.

    It is the softmax-weighted mean of the cells about the best cell of the whole grid (the first
    in the order x, y, z among equals). The mean spans the same number of cells to both sides, so
    a best cell on the border of the cube is not pulled inwards.
    """
    planes = [plane.contiguous().cpu().numpy() for plane in score_planes(logits.float(), views)]
    points = np.empty((len(logits), 3), np.float32)
    _decode(*planes, points)
    return torch.from_numpy(points).to(logits.device)


def score_planes(
    logits: Float[torch.Tensor, "b v h w"], views: Sequence[View] = VIEWS
) -> tuple[
    Float[torch.Tensor, "b x y"], Float[torch.Tensor, "b x z"], Float[torch.Tensor, "b y z"]
]:
    """Log-probabilities turned to cube axes and added: A(x, y), B(x, z), C(y, z).

    A plane that no view shows is 0.
    """
    heights = logits.flatten(-2).log_softmax(dim=-1).view_as(logits)
    along_axes = heights.flip(-2).transpose(-1, -2).unbind(dim=1)
    planes: dict[tuple[int, int], Tensor] = {}
    for view, plane in zip(views, along_axes, strict=True):
        axes = view.u_axis, view.v_axis
        turned = plane if view.u_sign > 0 else plane.flip(-2)
        planes[axes] = planes[axes] + turned if axes in planes else turned
    nothing = torch.zeros_like(along_axes[0])
    xy, xz, yz = (planes.get(axes, nothing) for axes in ((0, 1), (0, 2), (1, 2)))
    return xy, xz, yz


@compiled
def _decode(xy: np.ndarray, xz: np.ndarray, yz: np.ndarray, points: np.ndarray) -> None:
    for b in range(len(points)):
        x, y, z = _best_cell(xy[b], xz[b], yz[b])
        _refine(xy[b], xz[b], yz[b], (x, y, z), points[b])


@compiled
def _best_cell(xy: np.ndarray, xz: np.ndarray, yz: np.ndarray) -> tuple[int, int, int]:
    """First cell with the highest xy + xz + yz; columns that cannot reach it are skipped.

    Rounding is monotone: the bound, added in the same order, is never below a score it bounds.
    """
    cells = len(xy)
    best, found = np.float32(-np.inf), (0, 0, 0)
    peak_xz, peak_yz = np.empty(cells, np.float32), np.empty(cells, np.float32)
    for i in range(cells):
        peak_xz[i], peak_yz[i] = xz[i].max(), yz[i].max()
    for x in range(cells):
        for y in range(cells):
            if xy[x, y] + peak_xz[x] + peak_yz[y] <= best:
                continue
            if not _any_above(best, xy[x, y], xz[x], yz[y]):
                continue
            for z in range(cells):
                score = xy[x, y] + xz[x, z] + yz[y, z]
                if score > best:
                    best, found = score, (x, y, z)
    return found


@compiled
def _any_above(best: float, base: float, first: np.ndarray, second: np.ndarray) -> bool:
    """Whether a cell of one column beats `best`; without early exit, so that it vectorises."""
    hits = 0
    for z in range(len(first)):
        hits += base + first[z] + second[z] > best
    return hits > 0


@compiled
def _refine(
    xy: np.ndarray, xz: np.ndarray, yz: np.ndarray, cell: tuple[int, int, int], point: np.ndarray
) -> None:
    """Write the softmax-weighted mean of the cells about `cell`, in cube coordinates."""
    cells = len(xy)
    x0, y0, z0 = cell
    rx = min(REFINE_CELLS, x0, cells - 1 - x0)
    ry = min(REFINE_CELLS, y0, cells - 1 - y0)
    rz = min(REFINE_CELLS, z0, cells - 1 - z0)
    peak = np.float64(xy[x0, y0] + xz[x0, z0] + yz[y0, z0])
    total, dx, dy, dz = 0.0, 0.0, 0.0, 0.0
    for x in range(x0 - rx, x0 + rx + 1):
        for y in range(y0 - ry, y0 + ry + 1):
            for z in range(z0 - rz, z0 + rz + 1):
                weight = np.exp(np.float64(xy[x, y] + xz[x, z] + yz[y, z]) - peak)
                total += weight
                dx += weight * (x - x0)
                dy += weight * (y - y0)
                dz += weight * (z - z0)
    point[0] = (x0 + dx / total + 0.5) * 2 / cells - 1
    point[1] = (y0 + dy / total + 0.5) * 2 / cells - 1
    point[2] = (z0 + dz / total + 0.5) * 2 / cells - 1
