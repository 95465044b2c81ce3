import sys

import pytest

from leaderboard.agents import PROBES, find_agent, known_agents
from sacil_tasks.errors import UsageError


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """A package that must not be imported to be found."""
    package = tmp_path / "foreign_h6"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('imported too early')")
    (package / "policy.py").write_text("")
    (tmp_path / "single_h6.py").write_text("raise RuntimeError('imported too early')")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", PROBES)
def test_probes_load_and_are_privileged(name):
    policy = find_agent(name).load(checkpoint=None, tasks=("pick_and_lift",))
    assert policy.privileged


def test_a_probe_takes_no_checkpoint(tmp_path):
    with pytest.raises(UsageError, match="no weights"):
        find_agent("oracle").load(checkpoint=tmp_path, tasks=("pick_and_lift",))


@pytest.mark.parametrize("name", sorted(known_agents()))
def test_every_agent_file_is_found_by_its_name_without_torch(name):
    assert find_agent(name).target.endswith(f".{name}:load")
    assert find_agent(f"{name}:some_variant").variant == "some_variant"


@pytest.mark.parametrize("name", ["foreign_h6.policy:load", "single_h6:make"])
def test_a_foreign_policy_is_found_and_not_imported(foreign, name):
    assert find_agent(name).target == name
    assert "foreign_h6" not in sys.modules


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("oracel", "Did you mean oracle"),
        ("oracle:fast", "has no variants"),
        ("no_such.module:load", "no module no_such.module"),
        ("nothing_here:load", "no agent called 'nothing_here'"),
        ("", "no agent called ''"),
        (":", "no agent called ''"),
        ("..:load", "no module"),
    ],
)
def test_unknown_names_are_one_sentence(name, sentence):
    with pytest.raises(UsageError, match=sentence):
        find_agent(name)


def test_a_module_without_the_attribute_is_one_sentence(foreign):
    ref = find_agent("json:no_such_function")
    with pytest.raises(UsageError, match="cannot be loaded from json:no_such_function"):
        ref.load(checkpoint=None, tasks=())
