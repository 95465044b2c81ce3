from dataclasses import fields, replace

import pytest

from leaderboard.protocol import EvalProtocol, protocol_of
from sacil_tasks.catalog import task_names

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
