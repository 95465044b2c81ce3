import numpy as np
import pytest
import torch
from torch import nn

from baselines.optim import Ema, Lamb, learning_rate


def slow_lamb(weight, gradients, *, lr, decay):
    """The published rule, one number at a time, in double precision."""
    mean, square = np.zeros_like(weight), np.zeros_like(weight)
    for gradient in gradients:
        update = np.empty_like(weight)
        for i in np.ndindex(weight.shape):
            mean[i] = 0.9 * mean[i] + 0.1 * gradient[i]
            square[i] = 0.999 * square[i] + 0.001 * gradient[i] ** 2
            update[i] = mean[i] / (square[i] ** 0.5 + 1e-6) + decay * weight[i]
        norms = min((weight**2).sum() ** 0.5, 10.0), (update**2).sum() ** 0.5
        ratio = norms[0] / norms[1] if all(norms) else 1.0
        weight = weight - lr * ratio * update
    return weight


@pytest.mark.parametrize("scale", [0.0, 0.5, 40.0])  # zero norm, ordinary, above the clamp
def test_lamb_follows_the_published_rule(scale):
    torch.manual_seed(0)
    layer = nn.Linear(4, 3, bias=False)
    with torch.no_grad():
        layer.weight.mul_(scale)
    gradients = [torch.randn(3, 4) for _ in range(5)]
    expected = slow_lamb(
        layer.weight.detach().double().numpy(),
        [g.double().numpy() for g in gradients],
        lr=0.01,
        decay=0.1,
    )
    optimiser = Lamb(layer, weight_decay=0.1)
    for gradient in gradients:
        layer.weight.grad = gradient.clone()
        optimiser.step(0.01)
    np.testing.assert_allclose(layer.weight.detach().numpy(), expected, rtol=2e-5, atol=1e-6)


def test_lamb_leaves_a_parameter_without_gradient_alone():
    layer = nn.Linear(2, 2)
    before = layer.bias.detach().clone()
    layer.weight.grad = torch.ones(2, 2)
    Lamb(layer, weight_decay=0.1).step(0.1)
    assert torch.equal(layer.bias, before)
    assert layer.weight.grad is None


def test_schedule_hits_the_published_values():
    def rate(step):
        return learning_rate(step, total=133_320, peak=1.8e-3, warmup=2000)

    assert rate(0) == pytest.approx(1.8e-3 / 2000)
    assert rate(1999) == pytest.approx(1.8e-3)
    assert rate(133_319) == pytest.approx(1.06 * 1.8e-5, rel=0.01)


def test_schedule_rises_then_falls_however_short_the_run():
    for total in (1, 2, 7, 30, 500):
        rates = [learning_rate(s, total=total, peak=1.0, warmup=200) for s in range(total)]
        top = rates.index(max(rates))
        assert rates[: top + 1] == sorted(rates[: top + 1])
        assert rates[top:] == sorted(rates[top:], reverse=True)
        assert min(rates) > 0


def test_average_of_a_constant_is_the_constant():
    layer = nn.Linear(3, 3)
    ema = Ema(layer, decay=0.99)
    for step in range(20):
        ema.update(step)
    for name, weight in layer.named_parameters():
        torch.testing.assert_close(ema.average[name], weight.detach())


def test_average_forgets_its_start_quickly_then_moves_at_its_decay():
    layer = nn.Linear(1, 1)
    nn.init.zeros_(layer.weight)
    ema = Ema(layer, decay=0.9)
    nn.init.ones_(layer.weight)
    ema.update(0)
    assert float(ema.average["weight"]) == pytest.approx(0.9)  # decay 1/10
    before = float(ema.average["weight"])
    ema.update(10_000)
    assert float(ema.average["weight"]) == pytest.approx(before + 0.1 * (1 - before))


def test_average_without_decay_is_the_raw_network():
    layer = nn.Linear(2, 2)
    ema = Ema(layer, decay=0.0)
    nn.init.constant_(layer.weight, 3.0)
    ema.update(100)
    assert torch.equal(ema.weights(layer)["weight"], layer.weight)
