from dataclasses import fields, replace

import numpy as np
import pytest

from leaderboard.protocol import UNRULED, EvalProtocol, protocol_name, protocol_of
from sacil_tasks.catalog import task_names, task_spec

PROTOCOL = protocol_of("pick_and_lift", "test", 0)


@pytest.mark.parametrize("field", [field.name for field in fields(EvalProtocol)])
def test_changing_any_field_changes_the_hash(field):
    assert replace(PROTOCOL, **{field: "something else"}).hash != PROTOCOL.hash


def test_the_hash_is_that_of_equal_values():
    assert protocol_of("pick_and_lift", "test", 0).hash == PROTOCOL.hash


def test_tasks_partitions_and_scene_sets_have_hashes_of_their_own():
    protocols = [
        protocol_of(task, partition, scene_set)
        for task in task_names()
        for partition in ("val", "test")
        for scene_set in (0, 1)
    ]
    assert len({protocol.hash for protocol in protocols}) == len(protocols)


@pytest.mark.parametrize("task", task_names())
def test_splits_that_the_ladder_alone_defines_share_a_protocol(task):
    supported = set(UNRULED) & set(task_spec(task).splits)
    assert len({protocol_of(task, "test", 0, split).hash for split in supported}) == 1


@pytest.mark.parametrize("task", task_names())
def test_other_splits_have_hashes_of_their_own(task):
    names = {protocol_name(task, split) for split in task_spec(task).splits}
    hashes = {protocol_of(task, "test", 0, split).hash for split in task_spec(task).splits}
    assert len(hashes) == len(names)


@pytest.mark.sim
def test_the_declared_simulator_is_the_real_one():
    from mani_skill.utils import sapien_utils

    from sacil_tasks.episode import SceneKey, Stage

    stage = Stage("pick_and_lift")
    stage.begin(SceneKey("pick_and_lift", "val", 0, 0), variation=0)
    env, declared = stage.env, PROTOCOL
    scene = env.sim_config.scene_config
    assert (env.sim_freq, env.control_freq) == (declared.sim_freq_hz, declared.control_freq_hz)
    assert scene.solver_position_iterations == declared.solver_position_iterations
    assert scene.contact_offset == declared.contact_offset_m
    assert (env.agent.uid, env.control_mode) == (declared.robot, declared.controller)
    assert env.backend.sim_backend == declared.simulator
    assert tuple(env.scene.sensors) == declared.camera_names
    for name, sensor in env.scene.sensors.items():
        config = sensor.config
        assert (config.width, config.height) == (declared.image_pixels,) * 2
        assert config.shader_pack == declared.shader
        fov_deg = declared.wrist_fov_deg
        if name in declared.cameras:
            place = declared.cameras[name]
            fov_deg = place.fov_deg
            real = config.pose.raw_pose[0].numpy()
            aimed = sapien_utils.look_at(place.eye_m, place.target_m).raw_pose[0].numpy()
            assert real == pytest.approx(aimed, abs=1e-6)
        assert np.rad2deg(config.fov) == pytest.approx(fov_deg)
    stage.close()
