"""The robot's lighter meshes: same shape to a camera, same physics."""

import gymnasium as gym
import numpy as np
import pytest
import sapien
import trimesh

from sacil_tasks import robot_looks, table
from sacil_tasks.cameras import observe
from sacil_tasks.catalog import env_id


def test_a_ball_stays_a_ball_with_a_tenth_of_its_triangles() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    lighter = robot_looks.simplified(ball)
    assert len(lighter.faces) == pytest.approx(len(ball.faces) / 10, rel=0.02)
    assert np.linalg.norm(lighter.vertices, axis=1) == pytest.approx(0.1, abs=0.001)
    assert lighter.volume == pytest.approx(ball.volume, rel=0.02)
    outwards = (lighter.vertex_normals * lighter.vertices).sum(axis=1) / 0.1
    assert np.median(outwards) > 0.99, "a smooth surface is shaded smoothly"
    assert outwards.min() > 0.7


def test_edges_of_a_box_stay_sharp() -> None:
    box = robot_looks.simplified(trimesh.creation.box())
    assert np.abs(box.vertex_normals).max(axis=1) == pytest.approx(1.0)


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
    monkeypatch.setattr(table, "lighten", lambda robot: None)
    full, many, as_many = _seen()
    assert shapes == as_many
    assert few < many / 7
    off = np.abs(light.depth_mm.astype(int) - full.depth_mm) > 5
    assert (off.mean(axis=(1, 2)) < (0.01, 0.01, 0.01, 0.03)).all()
    coloured = np.ptp(full.rgb.astype(int), axis=-1) > 60
    assert coloured.sum() > 50, "the blocks are in view"
    assert np.array_equal(light.rgb[:3][coloured[:3]], full.rgb[:3][coloured[:3]])
