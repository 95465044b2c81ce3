"""The robot's lighter meshes: same shape to a camera, same physics."""

import gymnasium as gym
import numpy as np
import pytest
import sapien
import trimesh

from sacil_tasks import robot_looks
from sacil_tasks.cameras import observe
from sacil_tasks.catalog import env_id


def test_merging_keeps_a_surface_to_within_a_cell() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    vertices_m, triangles = robot_looks.merged(
        ball.vertices.astype(np.float32), ball.faces.astype(np.uint32), 0.01
    )
    assert len(triangles) < len(ball.faces) / 5
    assert np.abs(np.linalg.norm(vertices_m, axis=1) - 0.1).max() < 0.002
    lighter = trimesh.Trimesh(vertices_m, triangles, process=False)
    assert lighter.volume == pytest.approx(ball.volume, rel=0.03)
    assert (lighter.area_faces > 0).all()
    assert len(np.unique(np.sort(triangles, axis=1), axis=0)) == len(triangles)


def test_a_mesh_smaller_than_a_cell_vanishes() -> None:
    ball = trimesh.creation.icosphere(radius=0.001)
    _, triangles = robot_looks.merged(ball.vertices + 0.5, ball.faces.astype(np.uint32), 0.01)
    assert len(triangles) == 0


def _seen():
    made = gym.make(env_id("pick_and_lift"), obs_mode="none", render_backend="cpu")
    env = made.unwrapped
    env.reset(seed=5)
    seen = observe(env, step=0, max_steps=25, gripper_open=True)
    triangles, collisions = 0, 0
    for link in env.agent.robot.links:
        entity = link._objs[0].entity  # noqa: SLF001
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is not None:
            triangles += sum(len(p.triangles) for s in body.render_shapes for p in s.parts)
        collisions += len(link._bodies[0].collision_shapes)  # noqa: SLF001
    made.close()
    return seen, triangles, collisions


@pytest.mark.sim
def test_cameras_see_the_same_scene_with_a_tenth_of_the_triangles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    light, few, shapes = _seen()
    monkeypatch.setattr(robot_looks, "lighten", lambda robot: None)
    full, many, as_many = _seen()
    assert shapes == as_many
    assert few < many / 7
    off = np.abs(light.depth_mm.astype(int) - full.depth_mm) > 5
    assert (off.mean(axis=(1, 2)) < (0.01, 0.01, 0.01, 0.03)).all()
    coloured = np.ptp(full.rgb.astype(int), axis=-1) > 60
    assert coloured.sum() > 50, "the blocks are in view"
    assert np.array_equal(light.rgb[:3][coloured[:3]], full.rgb[:3][coloured[:3]])
