"""The contrasts: what is a negative, what is measured, and against what chance."""

from dataclasses import replace

import pytest
import torch
from networks import make_batch

from baselines.scene.sight import ViewSight
from sacil_agent.contrast import (
    Contrast,
    cosine_matrix,
    diagnostics,
    info_nce,
    same_meaning,
    size_candidates,
)


def test_without_duplicates_it_is_the_mean_of_two_cross_entropies() -> None:
    logits = torch.randn(5, 5)
    rows = -logits.log_softmax(1).diagonal().mean()
    columns = -logits.log_softmax(0).diagonal().mean()
    found = info_nce(logits, torch.eye(5, dtype=torch.bool))
    torch.testing.assert_close(found, (rows + columns) / 2)


def test_duplicates_are_not_pushed_apart() -> None:
    logits = torch.randn(4, 4, requires_grad=True)
    same = torch.eye(4, dtype=torch.bool)
    same[0, 1] = same[1, 0] = True
    info_nce(logits, same).backward()
    assert logits.grad is not None
    assert logits.grad[0, 1] == logits.grad[1, 0] == 0
    assert logits.grad[0, 2] > 0


def test_a_batch_of_one_meaning_costs_nothing() -> None:
    logits = torch.randn(3, 3, requires_grad=True)
    loss = info_nce(logits, torch.ones(3, 3, dtype=torch.bool))
    loss.backward()
    assert loss == 0
    assert logits.grad is not None
    assert (logits.grad == 0).all()


def test_rows_of_one_trajectory_or_one_meaning_are_no_negatives() -> None:
    batch = make_batch(ViewSight(8), size=4)
    batch = replace(
        batch, meaning=torch.tensor([0, 1, 2, 0]), trajectory=torch.tensor([5, 6, 6, 7])
    )
    expected = torch.eye(4, dtype=torch.bool)
    for pair in ((0, 3), (1, 2)):
        expected[pair] = expected[pair[::-1]] = True
    assert torch.equal(same_meaning(batch), expected)


def test_the_temperature_is_learnt_and_bounded() -> None:
    contrast = Contrast(4, 6, 8)
    assert float(contrast.log_scale.exp()) == pytest.approx(1 / 0.07)
    eye = torch.eye(3, dtype=torch.bool)
    ours, theirs = torch.randn(3, 4), torch.randn(3, 6)
    with torch.no_grad():
        contrast.log_scale.fill_(100.0)
    loss, cosines = contrast(ours, theirs, eye)
    torch.testing.assert_close(loss, info_nce(100 * cosines, eye))


def test_cosines_are_those_of_full_precision_under_autocast() -> None:
    ours, theirs = torch.randn(3, 4), torch.randn(3, 4)
    with torch.autocast("cpu", torch.bfloat16):
        found = cosine_matrix(ours, theirs)
    expected = torch.cosine_similarity(ours[:, None], theirs[None], dim=-1)
    torch.testing.assert_close(found, expected)


def test_candidates_are_one_row_of_each_meaning_of_the_task() -> None:
    task = torch.tensor([0, 0, 0, 0, 1])
    meaning = torch.tensor([3, 4, 4, 3, 9])
    expected = torch.tensor(
        [[1, 1, 0, 0, 0], [1, 1, 0, 0, 0], [1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 1]]
    )
    assert torch.equal(size_candidates(task, meaning), expected.bool())


def test_accuracy_counts_first_and_later_keyframes_apart() -> None:
    batch = replace(
        make_batch(ViewSight(8), size=3),
        task=torch.zeros(3, dtype=torch.long),
        meaning=torch.tensor([0, 1, 2]),
        first=torch.tensor([True, False, False]),
    )
    cosines = torch.tensor([[0.1, 0.9, 0.0], [0.0, 0.9, 0.1], [0.9, 0.0, 0.1]])
    found = {name: float(value) for name, value in diagnostics("itc", cosines, batch).items()}
    assert found["itc/accuracy_first"] == 0
    assert found["itc/accuracy_later"] == 0.5
    assert found["itc/chance_first"] == pytest.approx(1 / 3)
    assert found["itc/chance_later"] == pytest.approx(1 / 3)


def test_groups_without_a_choice_are_nan() -> None:
    batch = replace(
        make_batch(ViewSight(8), size=2),
        task=torch.tensor([0, 1]),
        meaning=torch.tensor([0, 1]),
        first=torch.tensor([True, True]),
    )
    assert all(value.isnan() for value in diagnostics("cgc", torch.eye(2), batch).values())
