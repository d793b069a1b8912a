"""Branches on masks in a record: taken always, but where code raises or loops; the door finds what that changes."""

from typing import Any

import pytest
import torch
from torch import Tensor

from pgkit.compiled import compiled, every_branch
from pgkit.errors import UserError


def native(function: Any, *inputs: Tensor, others: Any = (), mode: Any = "record") -> Any:
    door = compiled(
        every_branch(function, None, *inputs), {}, lambda *_: [(None, *x) for x in others], mode, "it", fixed=True
    )
    return door.bind(None, *inputs), door.rung


def halves(_: Any, x: Tensor) -> list[Tensor]:
    """Halves and raises by 1 what is above 1, and stops if something is no number."""
    assert not x.isnan().any(), "NaN"
    big, y = x > 1, x.clone()
    if big.any():
        y[big] *= 0.5
        z = torch.stack([y, y - 1], -1)
        z[big] += 2.0
        y[big] = z[:, 1][big]
    if not (y < 0).all():
        y = torch.where(y < 0, y, y + 10)
    return [y]


def test_a_branch_that_was_empty_when_recorded_is_in_the_record():
    call, rung = native(halves, torch.tensor([-1.0, -2.0]), others=[[torch.tensor([3.0, -4.0])]])
    assert rung == "recorded, not compiled"
    assert call(torch.tensor([3.0, -4.0]))[0].tolist() == [12.5, -4.0]
    assert call(torch.tensor([-3.0, -4.0]))[0].tolist() == [-3.0, -4.0]
    with pytest.raises(AssertionError, match="NaN"):  # decided by the values still
        call(torch.tensor([3.0, float("nan")]))


def test_a_branch_that_changes_something_under_an_empty_mask_is_not_recorded():
    def counts(_: Any, x: Tensor) -> list[Tensor]:
        if (x > 1).any():
            x = x + 1
        return [x]

    with pytest.raises(UserError, match="it differs on other inputs"):
        native(counts, torch.zeros(2), others=[[torch.zeros(2)], [torch.ones(2) * 3]])


def test_a_record_that_picks_as_many_elements_as_a_mask_says_is_refused():
    def picks(_: Any, x: Tensor) -> list[Tensor]:
        return [x[x > 0].sum()]

    with pytest.raises(UserError, match="values decide how many elements it picks"):
        native(picks, torch.ones(2))


def test_a_loop_until_a_mask_is_empty_is_not_recorded():
    def until(_: Any, x: Tensor) -> list[Tensor]:
        while (x > 0).any():
            x = x - 1
        return [x]

    with pytest.raises(RuntimeError, match="'until' repeats until a mask is empty"):
        native(until, torch.tensor([2.5]))


def test_outside_a_record_the_values_decide():
    assert every_branch(halves, None, torch.zeros(1))(None, torch.tensor([-1.0]))[0].tolist() == [-1.0]
